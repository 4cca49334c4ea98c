"""Adam."""

from dataclasses import dataclass

import numpy as np

from bench.model import OptimizerState, param

from .clipped import Clipped


@dataclass(frozen=True)
class Adam(Clipped):
    """Adam (Kingma, Ba 2015): theta - rate m / (sqrt(v) + eps) with bias-corrected means m of g and v of g^2.

    The step is about ``rate`` per element for gradients of any size, so that one rate suits costs of any scale.
    """

    name = "adam"

    beta1: float = param(0.9, "decay of the mean gradient", low=0.0, high=0.999999)
    beta2: float = param(0.999, "decay of the mean square", low=0.0, high=0.999999)
    eps: float = param(1e-8, "added to the square root", positive=True)

    def start(self, theta: np.ndarray) -> OptimizerState:
        """Return the initial state, with both means at 0."""
        return super().start(theta) | {"mean": np.zeros(len(theta)), "square": np.zeros(len(theta))}

    def step(self, state: OptimizerState, gradient: np.ndarray) -> OptimizerState:
        i, g = state["iteration"] + 1, self.clipped(gradient)
        mean = self.beta1 * state["mean"] + (1 - self.beta1) * g
        square = self.beta2 * state["square"] + (1 - self.beta2) * g * g
        move = mean / (1 - self.beta1**i) / (np.sqrt(square / (1 - self.beta2**i)) + self.eps)
        return {"theta": state["theta"] - self.rate_at(i) * move, "mean": mean, "square": square, "iteration": i}
