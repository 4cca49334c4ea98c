"""A stiff stop 3.6 standard deviations away: continuous, met by 1 sample in 6,300."""

from dataclasses import dataclass

import numpy as np

from bench.plugin import FunctionScene, param


@dataclass(frozen=True)
class FarStop(FunctionScene):
    """x + k max(0, x - z)."""

    name = "far_stop"
    continuous = True
    sigma: float = param(1.0, "noise", positive=True)
    stiffness: float = param(2e4, "k")
    at: float = param(3.6, "z")

    def theta0(self):
        return np.array([0.0])

    def cost(self, xp, x):
        return x[0] + self.stiffness * xp.maximum(x[0] - self.at, 0.0 * x[0])
