"""Eight steps up or down by coins whose odds depend on theta and on the place: discrete events in a row."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, Events, EventScene, FunctionScene, Plugin, param


@dataclass(frozen=True)
class CoinWalk(EventScene, FunctionScene):
    """From 0, q takes 8 steps up (+1) or down (-1), up with the probability Phi(x_0 - x_1 q) at place q.

    x = theta + sigma u is (push, pull), and f = (q_end - goal)^2 + effort x_0^2. A step is up where the scene's own
    normal number e is below x_0 - x_1 q, so that theta changes probabilities only, and the derivative of f at given
    noise is (2 effort x_0, 0). The distribution of q has a recursion, whose derivative gives grad J, averaged over u by a
    Gauss-Hermite rule. Markov chains in
    discrete time are among the examples of Arya et al. 2022.
    """

    name = "coin_walk"
    theta_names = ("push", "pull")
    neglected_effects = "inertia, the time between steps"
    continuous = False
    discrete = True
    exogenous = 8

    push: float = param(0.2, "x_0 at theta, in standard deviations of the coin's normal number")
    pull: float = param(0.15, "x_1 at theta, per step away from 0")
    goal: float = param(3.0, "place where the steps should end", "steps")
    effort: float = param(2.0, "weight of the squared push", low=0.0)

    def cost(self, xp: Any, x: Array, e: Array) -> Array:
        q = 0.0 * x[0] + 0.0 * e[0]
        for t in range(self.exogenous):
            up = e[t] < x[0] - x[1] * q
            q = q + xp.where(up, 0.0 * q + 1.0, 0.0 * q - 1.0)
        return (q - self.goal) ** 2 + self.effort * x[0] ** 2

    def events(self, theta: np.ndarray, w: np.ndarray) -> Events:
        x = np.reshape(theta, (2, 1)) + self.sigma * w[:2]
        q = np.zeros(w.shape[1])
        limits, slopes = [], []
        for e in w[2:]:
            limits.append(x[0] - x[1] * q)
            slopes.append(np.stack([np.ones_like(q), -q]))
            q = q + np.where(e < limits[-1], 1.0, -1.0)
        return Events(np.eye(len(w))[2:], np.array(limits), np.array(slopes))

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray:
        """Return the derivative of the recursion of the places' probabilities, averaged over the noise on theta."""
        # nodes of the Gauss-Hermite rule per coordinate of theta: exact for polynomials up to degree 47
        nodes, weights = np.polynomial.hermite_e.hermegauss(24)
        weights = weights / weights.sum()
        u = np.stack(np.meshgrid(nodes, nodes, indexing="ij")).reshape(2, -1)
        slope = self._slope(self.theta0()[:, None] + self.sigma * u)
        mean = np.asarray(slope @ np.outer(weights, weights).ravel())
        return np.asarray(mean + np.array([2 * self.effort * self.push, 0.0]))

    def _slope(self, x: np.ndarray) -> np.ndarray:
        """Return the gradient of the mean of (q_end - goal)^2 at ``x (2, B)``, without noise on it, ``(2, B)``."""
        from scipy.special import ndtr

        places = np.arange(-self.exogenous, self.exogenous + 1)[:, None]
        limit = x[0] - x[1] * places
        p, density = ndtr(limit), np.exp(-0.5 * limit**2) / np.sqrt(2 * np.pi)
        slopes = np.stack([density, -places * density])
        chance = np.zeros_like(p)
        chance[self.exogenous] = 1.0
        change = np.zeros_like(slopes)
        for _ in range(self.exogenous):
            moved = slopes * chance + p * change
            # np.roll moves nothing around the ends, which are reached after the last step only
            change = np.roll(moved, 1, axis=1) + np.roll(change - moved, -1, axis=1)
            chance = np.roll(p * chance, 1, axis=0) + np.roll((1 - p) * chance, -1, axis=0)
        return np.asarray((change * (places - self.goal) ** 2).sum(axis=1))
