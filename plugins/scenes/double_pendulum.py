"""A double pendulum: chaos without contact."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, MechanicalScene, State, param


@dataclass(frozen=True)
class DoublePendulum(MechanicalScene):
    """Two equal point masses on two equal rods; q contains each rod's absolute angle from hanging down.

    State (q1, q2, v1, v2); theta = its initial value, with parameter noise; f = 1 - cos q1 at the end. Equal masses
    cancel in the motion and only scale the :meth:`energy`. Sample gradients grow exponentially with the horizon, while
    costs, and therefore the zeroth-order variance, are bounded.
    """

    name = "double_pendulum"
    neglected_effects = "the rods' mass, friction, torques"
    continuous = True
    n_q = 2

    sigma: float = param(0.1, "standard deviation of the noise on the initial state", "rad and rad/s", positive=True)
    mass: float = param(0.1, "each point mass", "kg", positive=True)
    length: float = param(1.0, "length of each rod", "m", positive=True)
    gravity: float = param(9.81, "gravitational acceleration", "m/s^2")

    def without_effect(self, contact: ContactLaw | None) -> tuple[str, ...]:
        return ("mass",)

    def theta0(self) -> np.ndarray:
        """Return rod 1 horizontal, swinging up at 5 rad/s, and rod 2 hanging, swinging at -5 rad/s."""
        return np.array([0.5 * np.pi, 0.0, 5.0, -5.0])

    def initial_state(self, xp: Any, theta: Array) -> State:
        return State(theta[:2], theta[2:])

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Return the solution of 2 q1'' + c q2'' = f1, c q1'' + q2'' = f2, c = cos(q1 - q2), by Cramer's rule."""
        c, s, pull = xp.cos(q[0] - q[1]), xp.sin(q[0] - q[1]), self.gravity / self.length
        f1 = -s * v[1] * v[1] - 2.0 * pull * xp.sin(q[0])
        f2 = s * v[0] * v[0] - pull * xp.sin(q[1])
        return xp.stack([f1 - c * f2, 2.0 * f2 - c * f1]) / (2.0 - c * c)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return 1.0 - xp.cos(q[0])

    def energy(self, xp: Any, q: Array, v: Array) -> Array:
        """Return kinetic plus potential energy, ``(B,)`` [J]."""
        kinetic = v[0] * v[0] + 0.5 * v[1] * v[1] + v[0] * v[1] * xp.cos(q[0] - q[1])
        potential = -self.gravity / self.length * (2.0 * xp.cos(q[0]) + xp.cos(q[1]))
        return self.mass * self.length**2 * (kinetic + potential)
