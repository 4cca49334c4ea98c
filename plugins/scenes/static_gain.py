"""Copies of x' = x + u under one matrix of gains: a policy with many gauge directions, which do not change the cost."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, KnownOptimum, KnownValue, MechanicalScene, Plugin, State, param


@dataclass(frozen=True)
class StaticGain(KnownOptimum, KnownValue, MechanicalScene):
    """``copies`` of x' = x + u under the policy u = K x from x = (1, .., 1), for any matrix K (d = copies^2), initially 0.

    f = sum over the steps of x'x + effort u'u, plus ``end`` x'x. All copies move in the same way, so that only K 1
    matters: the other copies (copies - 1) of the copies^2 directions are gauge directions. With 100 copies over 10
    steps, effort .1 and end 10, J goes from 2000 at K = 0 to 109.1607978 at every K with K 1 = -.9160798. The step
    length is 1. x is the velocity and positions do not matter, so explicit and semi-implicit Euler agree.
    """

    name = "static_gain"
    neglected_effects = "positions, coupling of the copies"
    continuous = True

    sigma: float = param(0.1, "standard deviation of the noise on the gains, or on each control", positive=True)
    noise: str = param("parameter", "whether noise is on theta or on the actions", choices=("parameter", "action"))
    horizon: int = 10
    dt: float = 1.0
    copies: int = param(2, "length of x", low=1)
    gain: float = param(0.0, "every diagonal element of K at theta")
    effort: float = param(0.1, "weight of u'u", positive=True)
    end: float = param(10.0, "weight of x'x at the end", low=0.0)

    @property
    def n_q(self) -> int:  # type: ignore[override]
        """The number of copies. The positions are sums of x and affect nothing."""
        return self.copies

    @property
    def n_u(self) -> int:  # type: ignore[override]
        """The number of copies."""
        return self.copies

    def theta0(self) -> np.ndarray:
        """Return K row by row: ``gain`` on its diagonal."""
        return (self.gain * np.eye(self.copies)).ravel()

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return x = (1, .., 1), as the velocity."""
        zero = 0.0 * theta[:1]
        return State(xp.concat([zero] * self.copies), xp.concat([zero + 1.0] * self.copies))

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return u

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array:
        gains = xp.reshape(theta, (self.copies, self.copies, theta.shape[1]))
        return xp.sum(gains * v[None], axis=1)

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Return x'x + effort u'u."""
        return xp.sum(v * v, axis=0) + self.effort * xp.sum(u * u, axis=0)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return self.end * xp.sum(v * v, axis=0)

    def optimum(self, contact: ContactLaw | None, integrator: Plugin | None) -> tuple[float, str] | None:
        """Return the minimum cost over one constant gain k in [-2, 0]."""
        from scipy.optimize import minimize_scalar

        found = minimize_scalar(self.cost_of, bounds=(-2.0, 0.0), method="bounded", options={"xatol": 1e-12})
        return self.copies * float(found.fun), "search over a constant gain"

    def cost_of(self, k: float) -> float:
        """Return the cost of one copy under u = k x, a geometric sum."""
        powers = (1.0 + self.dt * k) ** (2 * np.arange(self.horizon + 1))
        return float((1.0 + self.effort * k * k) * powers[:-1].sum() + self.end * powers[-1])

    def cost_to_go(self, q: np.ndarray, v: np.ndarray, step: int) -> np.ndarray:
        """Return p x'x, ``(B,)``, with the p of ``step`` from the scalar Riccati recursion."""
        p = self.end
        for _ in range(self.horizon - step):
            p = 1.0 + p - (self.dt * p) ** 2 / (self.effort + self.dt**2 * p)
        return p * (v * v).sum(axis=0)
