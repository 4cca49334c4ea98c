"""A convex bowl in any dimension."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, Plugin, param

from .spaced import SpacedScene


@dataclass(frozen=True)
class Quadratic(SpacedScene):
    """f = sum_i c_i x_i^2 / 2, with x = theta + sigma w.

    The curvatures c_i are spaced geometrically from 1 to ``condition``; theta is spaced evenly from 0.5 to 1.5.
    grad J = c theta for any sigma.
    """

    name = "quadratic"
    neglected_effects = "dynamics"
    continuous = True

    condition: float = param(10.0, "largest curvature over the smallest", positive=True)

    def cost(self, xp: Any, x: Array) -> Array:
        exponents = xp.asarray(_exponents(self.dimension)[:, None], dtype=x.dtype)
        return 0.5 * xp.sum(self.condition**exponents * x * x, axis=0)

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray:
        return self.condition ** _exponents(self.dimension) * self.theta0()


def _exponents(dimension: int) -> np.ndarray:
    return np.linspace(0.0, 1.0, dimension)
