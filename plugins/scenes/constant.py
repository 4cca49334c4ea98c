"""A constant cost: every nonzero estimate is noise of the estimator."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, FunctionScene, Plugin, param


@dataclass(frozen=True)
class Constant(FunctionScene):
    """f = value, grad J = 0. Without a baseline, score-function terms still have variance (value / sigma)^2 each."""

    name = "constant"
    neglected_effects = "dynamics"
    continuous = True

    dimension: int = param(5, "d, length of theta", positive=True)
    value: float = param(3.0, "the cost")

    def theta0(self) -> np.ndarray:
        """Return numbers evenly spaced from 0.5 to 1.5."""
        return np.linspace(0.5, 1.5, self.dimension)

    def cost(self, xp: Any, x: Array) -> Array:
        """Return the value, with derivative 0."""
        return 0.0 * xp.sum(x, axis=0) + self.value

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray:
        return np.zeros(self.dimension)
