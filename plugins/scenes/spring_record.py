"""A spring and a damper fitted to a record of their motion: a cost with more local minima in longer records."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, KnownOptimum, MechanicalScene, Plugin, State, param


@dataclass(frozen=True)
class SpringRecord(KnownOptimum, MechanicalScene):
    """x'' = -k x - c x' from rest at 1; theta = (k, c) is to be identified; f = mean of (x - record)^2 over the steps.

    The record q[1] is the same motion with ``stiffness`` and ``damping``, in the same steps, so that J* = 0; x is q[0].
    theta starts with ``guess`` times the stiffness and no damping. Without damping, the mean squared difference of two
    motions whose frequencies differ by D, over a record of length T, is 1 - sin(DT) / (DT): from a difference above
    4.4934 / T, descent ends in a wrong local minimum.
    """

    name = "spring_record"
    neglected_effects = "noise in the record, an unknown mass or start (only k/m and c/m are identifiable)"
    continuous = True
    identifies = True
    n_q = 2
    n_u = 2

    sigma: float = param(0.1, "standard deviation of the noise on k and c", "1/s^2 and 1/s", positive=True)
    dt: float = 0.05
    stiffness: float = param(4.0, "k of the record", "1/s^2", positive=True)
    damping: float = param(0.2, "c of the record", "1/s", low=0.0)
    guess: float = param(1.3, "k at theta over that of the record", positive=True)

    def theta0(self) -> np.ndarray:
        return np.array([self.guess * self.stiffness, 0.0])

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return both motions at rest at 1."""
        return self.at_rest(xp, theta, 1.0, 1.0)

    def planned_controls(self, xp: Any, theta: Array) -> Array:
        return xp.zeros((self.horizon, 1, 1), dtype=theta.dtype) + theta

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return xp.stack([-u[0] * q[0] - u[1] * v[0], -self.stiffness * q[1] - self.damping * v[1]])

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return (q[0] - q[1]) ** 2 / self.horizon

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Return 0: the final state has no extra cost."""
        return 0.0 * q[0]

    def optimum(self, contact: ContactLaw | None, integrator: Plugin | None) -> tuple[float, str]:
        """Return 0, for any integrator."""
        return 0.0, "the record's own parameters"
