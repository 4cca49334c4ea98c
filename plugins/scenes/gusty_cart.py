"""A cart pushed in gusts of wind: process noise in addition to the noise on theta."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bench.model import Array, ContactLaw, Plugin, ProcessNoiseScene, State, param


@dataclass(frozen=True)
class GustyCart(ProcessNoiseScene):
    """A constant force theta (d = 1) plus a gust per step pushes a cart from rest; f = max(0, q_N - edge)^2.

    q_N = c (theta + sigma u) + b . gust e, with b_i = dt^2 (N - i) / mass for semi-implicit and dt^2 (N - i - 1) / mass
    for explicit Euler, and c the sum of b. So q_N is normal with mean m = c theta and variance s^2 = c^2 sigma^2 + gust^2
    |b|^2, and grad J = 2 c s (z Phi(z) + phi(z)) at z = (m - edge) / s. Without gusts the cart rarely passes the edge
    and the gradient is near 0, so the reference must average over the gusts.
    """

    name = "gusty_cart"
    continuous: ClassVar[bool] = True
    neglected_effects: ClassVar[str] = "friction, wind that lasts longer than a step"
    n_q: ClassVar[int] = 1
    n_u: ClassVar[int] = 1

    sigma: float = param(0.05, "standard deviation of the noise on the force", "N", positive=True)
    gust: float = param(2.0, "standard deviation of each step's gust", "N", low=0.0)
    horizon: int = param(20, "number of time steps", "steps", positive=True)
    dt: float = param(0.05, "length of a time step", "s", positive=True)
    mass: float = param(1.0, "mass of the cart", "kg", positive=True)
    force: float = param(1.0, "force at theta", "N")
    edge: float = param(0.75, "position that the cart should not pass", "m")

    def theta0(self) -> np.ndarray:
        """Return the force."""
        return np.array([self.force])

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return the state at rest at 0."""
        return State(0.0 * theta[:1], 0.0 * theta[:1])

    def planned_controls(self, xp: Any, theta: Array) -> Array:
        """Return the force at every step."""
        return xp.broadcast_to(theta[None, :1], (self.horizon, 1, theta.shape[1]))

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Return the force and the gust over the mass."""
        return u / self.mass

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the squared distance beyond the edge."""
        return xp.maximum(q[0] - self.edge, 0.0 * q[0]) ** 2

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray | None:
        """Return 2 c s (z Phi(z) + phi(z)), or None for an integrator without a formula here."""
        steps = {"semi_implicit_euler": 0, "explicit_euler": 1}
        if integrator is None or integrator.name not in steps:
            return None
        b = self.dt**2 * (self.horizon - steps[integrator.name] - np.arange(self.horizon)) / self.mass
        c = float(b.sum())
        if c == 0.0:  # one explicit step moves by the initial velocity, which is 0
            return np.zeros(1)
        s = math.hypot(c * self.sigma, self.gust * float(np.linalg.norm(b)))
        z = (c * self.force - self.edge) / s
        below = 0.5 * math.erfc(-z / math.sqrt(2.0))
        density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
        return np.array([2.0 * c * s * (z * below + density)])
