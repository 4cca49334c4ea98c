"""A plane with an oblique ledge: a jump whose size and slope differ along the boundary."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, Events, EventScene, FunctionScene, Plugin, half_spaces, param

_SLOPE = np.array([0.5, -1.0])
_CHANGE = np.array([2.0, 1.0])
_NORMAL = np.array([0.6, 0.8])


@dataclass(frozen=True)
class Ledge(EventScene, FunctionScene):
    """f = a . x, plus height + b . x where n . x >= edge, with x = theta + sigma w, |n| = 1 (d = 2).

    With z = (n . theta - edge) / sigma: grad J = a + b Phi(z) + n phi(z) ((height + b . theta) / sigma - z b . n). First
    order has the expectation a + b Phi(z), so it lacks the last term. a = (0.5, -1), b = (2, 1), n = (0.6, 0.8).
    """

    name = "ledge"
    neglected_effects = "dynamics; represents a contact that occurs or not, with another motion after it"
    continuous = False

    height: float = param(1.0, "size of the jump at x = 0, if the edge is there")
    edge: float = param(0.3, "distance of the edge from 0")

    def theta0(self) -> np.ndarray:
        """Return (0.1, 0.2), at n . theta = 0.22."""
        return np.array([0.1, 0.2])

    def cost(self, xp: Any, x: Array) -> Array:
        inside = _NORMAL[0] * x[0] + _NORMAL[1] * x[1] >= self.edge
        beyond = self.height + _CHANGE[0] * x[0] + _CHANGE[1] * x[1]
        return _SLOPE[0] * x[0] + _SLOPE[1] * x[1] + xp.where(inside, beyond, 0.0 * beyond)

    def events(self, theta: np.ndarray, w: np.ndarray) -> Events:
        """Return the event n . x >= edge."""
        return half_spaces(_NORMAL[None], np.array([self.edge]), self.sigma, theta, w)

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray:
        theta = self.theta0()
        z = (float(_NORMAL @ theta) - self.edge) / self.sigma
        density = math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
        jump = (self.height + float(_CHANGE @ theta)) / self.sigma - z * float(_CHANGE @ _NORMAL)
        return _SLOPE + _CHANGE * 0.5 * math.erfc(-z / math.sqrt(2)) + _NORMAL * density * jump
