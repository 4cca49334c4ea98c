"""A linear policy."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, Policy, affine, param


@dataclass(frozen=True)
class Linear(Policy):
    """u = W o + b. Theta holds W, row by row, then b. The initial weights are normal numbers of ``scale`` / sqrt(n)."""

    name = "linear"

    scale: float = param(0.1, "standard deviation of the initial weights, times the square root of the inputs", low=0.0)
    seed: int = param(0, "seed of the initial weights", low=0)

    def shapes(self, n_inputs: int, n_outputs: int) -> dict[str, tuple[int, ...]]:
        """Return ``weight (n_outputs, n_inputs)`` and ``bias (n_outputs,)``."""
        return {"weight": (n_outputs, n_inputs), "bias": (n_outputs,)}

    def initial(self, n_inputs: int, n_outputs: int) -> np.ndarray:
        drawn = np.random.default_rng(self.seed).standard_normal(n_outputs * n_inputs)
        return np.concatenate([self.scale / np.sqrt(n_inputs) * drawn, np.zeros(n_outputs)])

    def act(self, xp: Any, theta: Array, observations: Array) -> Array:
        """Return W o + b, ``(n_outputs, B)``."""
        n_inputs = observations.shape[0]
        arrays = self.arrays(xp, theta, n_inputs, theta.shape[0] // (n_inputs + 1))
        return affine(xp, arrays["weight"], arrays["bias"], observations)
