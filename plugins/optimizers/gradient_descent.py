"""Gradient descent."""

from dataclasses import dataclass

import numpy as np

from bench.model import OptimizerState

from .clipped import Clipped


@dataclass(frozen=True)
class GradientDescent(Clipped):
    """theta - rate g. At curvature k and gradient variance v, it converges to E J - J* = rate v / (2 (2 - rate k))."""

    name = "gradient_descent"

    def step(self, state: OptimizerState, gradient: np.ndarray) -> OptimizerState:
        i = state["iteration"] + 1
        return {"theta": state["theta"] - self.rate_at(i) * self.clipped(gradient), "iteration": i}
