"""A minimal example of a simulator with its own gradient: a smooth function plus a step, on columns ``(2, B)``."""

from __future__ import annotations

import numpy as np

theta = np.array([1.0, 0.5])


def cost(x: np.ndarray) -> np.ndarray:
    """Return sin(x0) x1 + x1^2, plus 0.3 where x0 > 1.1, for ``x (2, B)``: ``(B,)``."""
    value: np.ndarray = np.sin(x[0]) * x[1] + x[1] ** 2 + np.where(x[0] > 1.1, 0.3, 0.0)
    return value


def gradient(x: np.ndarray) -> np.ndarray:
    """Return the derivative without the step's contribution, ``(2, B)``."""
    return np.stack([np.cos(x[0]) * x[1], np.sin(x[0]) + 2 * x[1]])
