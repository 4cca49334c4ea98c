"""Descent on a smoothed cost whose radius shrinks during the search: a single-loop Gaussian homotopy."""

from dataclasses import dataclass

import numpy as np

from bench.model import Answer, OptimizerState, Population, param


@dataclass(frozen=True)
class Homotopy(Population):
    """theta - rate g with g the gradient of F(theta, t) = E f(theta + t v), and t to max(least, min(shrink t, t - speed F_t)).

    With speed 0 the radius t shrinks by a constant factor. Otherwise it adapts: it shrinks faster while a smaller radius
    lowers F, F_t = dF/dt > 0. These are the two rules of the single-loop Gaussian homotopy (Iwakiri, Wang, Ito, Takeda
    2022, algorithm 3). With pairs of points theta +- t v, g is the mean of (f_+ - f_-) v / 2t and F_t the mean of
    (f_+ + f_- - 2 f_0) (|v|^2 - d) / 2t, where the source has one-sided differences with samples of their own. On
    theta' A theta / 2, F_t = t tr A. On a wave cos(k theta) the slope of F is exp(-k^2 t^2 / 2) times that of the wave.
    Noise in F_t shrinks t as well, so a large speed needs many pairs.
    """

    name = "homotopy"

    pairs: int = param(50, "pairs of points per iteration", low=1)
    rate: float = param(0.01, "step per unit of gradient", positive=True)
    radius: float = param(1.0, "initial t, in units of theta", positive=True)
    shrink: float = param(0.95, "least reduction of t per iteration, as a factor", positive=True, high=1.0)
    speed: float = param(0.0, "reduction of t per unit of dF/dt", low=0.0)
    least: float = param(1e-3, "smallest t", positive=True)

    def start(self, theta: np.ndarray) -> OptimizerState:
        return super().start(theta) | {"radius": max(self.radius, self.least)}

    def draws(self, dim: int) -> int:
        return self.pairs

    def ask(self, state: OptimizerState, noise: np.ndarray) -> np.ndarray:
        theta, shift = state["theta"][:, None], state["radius"] * noise
        return np.concatenate([theta, theta + shift, theta - shift], axis=1)

    def tell(self, state: OptimizerState, theta: np.ndarray, answer: Answer) -> OptimizerState:
        """Return the state after a step in theta and in t; pairs with a cost that is not finite count as 0."""
        assert answer.value is not None
        t, d = state["radius"], len(theta)
        ahead, behind = answer.value[1:].reshape(2, -1)
        v = (theta[:, 1 : 1 + len(ahead)] - state["theta"][:, None]) / t
        with np.errstate(invalid="ignore"):
            odd, even = (ahead - behind) / (2 * t), (ahead + behind - 2 * answer.value[0]) / (2 * t)
        known = np.isfinite(odd) & np.isfinite(even)
        gradient = (np.where(known, odd, 0.0) * v).mean(axis=1)
        by_radius = float((np.where(known, even, 0.0) * ((v**2).sum(axis=0) - d)).mean())
        smaller = min(self.shrink * t, t - self.speed * by_radius)
        return {"theta": state["theta"] - self.rate * gradient, "radius": max(smaller, self.least)}
