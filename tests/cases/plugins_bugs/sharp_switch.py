"""A smoothed switch: the cost climbs by 5 over 1e-5, which no sample meets. Trusted by the rule, wrong by 0.6."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.plugin import Array, FunctionScene, param


@dataclass(frozen=True)
class SharpSwitch(FunctionScene):
    """x + h sigmoid((x - z) / width)."""

    name = "sharp_switch"
    continuous = True
    sigma: float = param(1.0, "noise", positive=True)
    height: float = param(5.0, "height of the switch")
    at: float = param(0.7, "place of the switch")
    width: float = param(1e-5, "width of the switch", positive=True)

    def theta0(self) -> np.ndarray:
        return np.array([0.0])

    def cost(self, xp: Any, x: Array) -> Array:
        return x[0] + self.height * 0.5 * (1 + xp.tanh((x[0] - self.at) / self.width))
