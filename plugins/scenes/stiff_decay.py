"""Exponential decay faster than the time step: an exact derivative of a wrong trajectory."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, Integrator, MechanicalScene, Plugin, State, param


@dataclass(frozen=True)
class StiffDecay(MechanicalScene):
    """x' = rate x, a first-order scene whose state is the velocity; theta = x_0, with parameter noise; f = x_N.

    One step multiplies x by the integrator's stability function R(rate dt), so that grad J = R^N for any sigma. At the
    default, rate dt = -2.5, R is -1.5 for explicit Euler and 1 / 3.5 for implicit Euler; the exact factor per step is
    e^-2.5. Outside the stability region, the derivative is exact for its program but useless.
    """

    name = "stiff_decay"
    theta_names = ("start",)
    neglected_effects = "positions, a second time scale"
    continuous = True
    n_q = 0
    n_v = 1

    sigma: float = param(0.1, "standard deviation of the noise on x_0", positive=True)
    horizon: int = 20
    dt: float = 0.05
    rate: float = param(-50.0, "growth rate, negative for decay", "1/s")
    start: float = param(1.0, "x_0 at theta")

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return no position and x_0 as velocity."""
        return State(theta[:0], theta)

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return self.rate * v

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return v[0]

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray | None:
        """Return R(rate dt)^N."""
        if not isinstance(integrator, Integrator):
            return None
        return np.array([float(np.real(integrator.amplification(self.rate * self.dt) ** self.horizon))])

    def physical_gradient(self) -> np.ndarray:
        """Return e^(rate T)."""
        return np.array([math.exp(self.rate * self.horizon * self.dt)])
