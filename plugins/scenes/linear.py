"""A plane: every unbiased gradient estimator is exact on average."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, Plugin, param

from .spaced import SpacedScene


@dataclass(frozen=True)
class Linear(SpacedScene):
    """f = sum_i a_i x_i, with x = theta + sigma w and a_i = slope (i + 1) / d for i = 0 .. d - 1.

    grad J = a for any sigma and theta; first-order gradients have variance 0.
    """

    name = "linear"
    neglected_effects = "dynamics"
    continuous = True

    slope: float = param(2.0, "the largest of the slopes a_i")

    def cost(self, xp: Any, x: Array) -> Array:
        return self.slope * xp.sum(xp.asarray(_ramp(self.dimension)[:, None], dtype=x.dtype) * x, axis=0)

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray:
        return self.slope * _ramp(self.dimension)


def _ramp(dimension: int) -> np.ndarray:
    return np.arange(1, dimension + 1) / dimension
