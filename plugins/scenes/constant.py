"""A constant cost: every nonzero estimate is noise of the estimator."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, Plugin, param

from .spaced import SpacedScene


@dataclass(frozen=True)
class Constant(SpacedScene):
    """f = value, grad J = 0. Without a baseline, score-function terms still have variance (value / sigma)^2 each."""

    name = "constant"
    neglected_effects = "dynamics"
    continuous = True

    value: float = param(3.0, "the cost")

    def cost(self, xp: Any, x: Array) -> Array:
        """Return the value, with derivative 0."""
        return 0.0 * xp.sum(x, axis=0) + self.value

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray:
        return np.zeros(self.dimension)
