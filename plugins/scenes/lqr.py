"""A mass brought to rest under a quadratic cost: the linear-quadratic regulator."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, KnownOptimum, KnownValue, OpenLoopScene, Plugin, State, param


@dataclass(frozen=True)
class Lqr(KnownOptimum, KnownValue, OpenLoopScene):
    """q'' = u from (q, v) = (``start``, 0); f = sum of position q^2 + speed v^2 + effort u^2, plus terminal terms.

    theta is the control of each step (d = horizon). Made for semi-implicit Euler, whose step is x' = A x + B u with
    A = [[1, h], [0, 1]] and B = [h^2, h]. J* = x0'P x0 with P from the Riccati recursion: 10.988683643 at the default.
    Noise of sigma on the controls adds sigma^2 (tr R + tr B'P B) per step to the optimal cost of feedback.
    """

    name = "lqr"
    theta_names = ("control",)
    neglected_effects = "contact, limits"
    continuous = True
    n_q = 1
    n_u = 1

    sigma: float = param(0.1, "standard deviation of the noise on each control", "m/s^2", positive=True)
    dt: float = 0.05
    start: float = param(1.0, "q at the start", "m")
    control: float = param(0.0, "control of every step at theta", "m/s^2")
    position: float = param(1.0, "weight of q^2", "1/m^2", low=0.0)
    speed: float = param(0.1, "weight of v^2", "s^2/m^2", low=0.0)
    effort: float = param(0.01, "weight of u^2", "s^4/m^2", positive=True)
    end_position: float = param(10.0, "weight of q^2 at the end", "1/m^2", low=0.0)
    end_speed: float = param(1.0, "weight of v^2 at the end", "s^2/m^2", low=0.0)

    def initial_state(self, xp: Any, theta: Array) -> State:
        return self.at_rest(xp, theta, self.start)

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return u

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return self.position * q[0] ** 2 + self.speed * v[0] ** 2 + self.effort * u[0] ** 2

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return self.end_position * q[0] ** 2 + self.end_speed * v[0] ** 2

    def optimum(self, contact: ContactLaw | None, integrator: Plugin | None) -> tuple[float, str] | None:
        """Return x0'P x0 for semi-implicit Euler, None for other integrators."""
        if getattr(integrator, "moves_with", "") != "new":
            return None
        return float(self.start**2 * _values(self)[0][0, 0]), "Riccati recursion"

    def cost_to_go(self, q: np.ndarray, v: np.ndarray, step: int) -> np.ndarray:
        """Return x'P x with the matrix P of ``step``, ``(B,)``."""
        x = np.concatenate([q, v])
        return np.einsum("ib,ij,jb->b", x, _values(self)[step], x)


@cache
def _values(scene: Lqr) -> list[np.ndarray]:
    """Return the matrices P of all steps, ending with the terminal weights, for semi-implicit Euler."""
    h = scene.dt
    a, b = np.array([[1.0, h], [0.0, 1.0]]), np.array([[h * h], [h]])
    p = np.diag([scene.end_position, scene.end_speed])
    values = [p]
    for _ in range(scene.horizon):
        gain = np.linalg.solve(scene.effort + b.T @ p @ b, b.T @ p @ a)
        p = np.diag([scene.position, scene.speed]) + a.T @ p @ (a - b @ gain)
        values.append(p)
    return values[::-1]
