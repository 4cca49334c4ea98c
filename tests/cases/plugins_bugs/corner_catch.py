"""A jump in a quadrant of the plane: both inputs above 2."""

from dataclasses import dataclass

import numpy as np

from bench.plugin import FunctionScene, param


@dataclass(frozen=True)
class CornerCatch(FunctionScene):
    """x_1 + h where x_0 > z and x_1 > z."""

    name = "corner_catch"
    sigma: float = param(1.0, "noise", positive=True)
    height: float = param(651.4, "h")
    at: float = param(2.0, "z")

    def theta0(self):
        return np.zeros(2)

    def cost(self, xp, x):
        return x[1] + xp.where((x[0] > self.at) & (x[1] > self.at), self.height + 0.0 * x[0], 0.0 * x[0])
