"""Swinging up a pendulum with a stage cost: a problem with a precisely known minimum."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, OpenLoopScene, State, param


@dataclass(frozen=True)
class PendulumSwing(OpenLoopScene):
    """A pendulum of unit constants, q'' = -sin q + u, is swung from rest at q = 0 to rest at q = pi.

    State (q, q'); theta is the torque of each step (d = horizon). f = sum over the steps of (q - pi)^2 + q'^2 +
    ``effort`` u^2, evaluated before each step, plus ``terminal`` times (q - pi)^2 + q'^2 at the end. f is smooth and
    not convex, with one known minimum: J* = 349.490460 at the default, computed by Newton's method to |gradient| <
    1e-9. Source: Suh et al. 2021, *Bundled gradients*, whose curve ends 2.2% above J*, since it minimises other weights
    than the reported ones.
    """

    name = "pendulum_swing"
    theta_names = ("torque",)
    neglected_effects = "units, damping, torque limits, contact"
    continuous = True
    n_q = 1
    n_u = 1

    sigma: float = param(0.3, "standard deviation of the noise on each torque", positive=True)
    horizon: int = 200
    dt: float = 0.05
    torque: float = param(0.1, "torque of every step at theta")
    effort: float = param(1.0, "weight of the squared torque", low=0.0)
    terminal: float = param(20.0, "weight of the end state", low=0.0)

    def initial_state(self, xp: Any, theta: Array) -> State:
        return self.at_rest(xp, theta, 0.0)

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Return -sin q + u."""
        return u - xp.sin(q)

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return self._distance(q, v) + self.effort * u[0] ** 2

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return self.terminal * self._distance(q, v)

    @staticmethod
    def _distance(q: Array, v: Array) -> Array:
        return (q[0] - np.pi) ** 2 + v[0] ** 2
