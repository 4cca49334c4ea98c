"""A narrow spike, 1.3e-4 wide at 3.1 standard deviations: quadrature finds it, and the reference is the sampled one."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.plugin import Array, FunctionScene, param


@dataclass(frozen=True)
class Spike(FunctionScene):
    """0.2 x + 3 exp(-(x - z)^2 / 2 width^2) / width."""

    name = "spike"
    continuous = True
    sigma: float = param(1.0, "noise", positive=True)
    width: float = param(1.8e-4, "width", positive=True)
    at: float = param(2.82, "place")

    def theta0(self) -> np.ndarray:
        return np.array([0.0])

    def cost(self, xp: Any, x: Array) -> Array:
        return 0.2 * x[0] + 3.0 * xp.exp(-((x[0] - self.at) ** 2) / (2 * self.width**2)) / self.width
