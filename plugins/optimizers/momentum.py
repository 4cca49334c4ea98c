"""Gradient descent with momentum."""

from dataclasses import dataclass

import numpy as np

from bench.model import OptimizerState, param

from .clipped import Clipped


@dataclass(frozen=True)
class Momentum(Clipped):
    """m = momentum m + g, then theta - rate m (Polyak 1964); with ``nesterov`` theta - rate (g + momentum m)."""

    name = "momentum"

    momentum: float = param(0.9, "share of the last step in the next one", low=0.0, high=1.0)
    nesterov: bool = param(False, "Nesterov momentum (Nesterov 1983)")

    def start(self, theta: np.ndarray) -> OptimizerState:
        """Return the initial state, with momentum 0."""
        return super().start(theta) | {"speed": np.zeros(len(theta))}

    def step(self, state: OptimizerState, gradient: np.ndarray) -> OptimizerState:
        i, g = state["iteration"] + 1, self.clipped(gradient)
        speed = self.momentum * state["speed"] + g
        move = g + self.momentum * speed if self.nesterov else speed
        return {"theta": state["theta"] - self.rate_at(i) * move, "speed": speed, "iteration": i}
