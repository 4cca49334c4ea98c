"""The base class of the gradient methods: gradient clipping and a decreasing rate."""

from dataclasses import dataclass

import numpy as np

from bench.model import Descent, OptimizerState, param


@dataclass(frozen=True)
class Clipped(Descent):
    """A gradient method with optional clipping and an optional rate decay of 1 / iteration^decay."""

    rate: float = param(0.01, "step per unit of gradient", positive=True)
    decay: float = param(0.0, "the rate at iteration i is rate / i^decay", low=0.0)
    clip: float | None = param(None, "largest gradient; null: no limit", positive=True)
    clip_by: str = param("norm", "whether the norm or each element is limited", choices=("norm", "element"))

    def start(self, theta: np.ndarray) -> OptimizerState:
        """Return the initial state, at iteration 0."""
        return super().start(theta) | {"iteration": 0}

    def clipped(self, gradient: np.ndarray) -> np.ndarray:
        """Return the gradient ``(d,)`` with its norm or its elements limited to ``clip``."""
        if self.clip is None:
            return gradient
        if self.clip_by == "element":
            return np.clip(gradient, -self.clip, self.clip)
        norm = np.linalg.norm(gradient)
        return gradient if norm <= self.clip else gradient * (self.clip / norm)

    def rate_at(self, iteration: int) -> float:
        """Return the rate of an iteration, counted from 1."""
        return self.rate / iteration**self.decay
