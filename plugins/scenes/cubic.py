"""A cubic: the simplest cost whose smoothed gradient differs from its gradient."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, Plugin

from .spaced import SpacedScene


@dataclass(frozen=True)
class Cubic(SpacedScene):
    """f = sum_i x_i^3 / 3, with x = theta + sigma w.

    grad J = theta^2 + sigma^2, while the gradient of f is theta^2. theta is spaced evenly from 0.5 to 1.5.
    """

    name = "cubic"
    neglected_effects = "dynamics"
    continuous = True

    def cost(self, xp: Any, x: Array) -> Array:
        """Return the sum of the cubes over 3."""
        return xp.sum(x * x * x, axis=0) / 3.0

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray:
        """Return theta^2 + sigma^2."""
        return self.theta0() ** 2 + self.sigma**2

    def physical_gradient(self) -> np.ndarray:
        """Return theta^2."""
        return self.theta0() ** 2
