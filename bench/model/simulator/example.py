"""The smallest simulator with its own gradient: a bowl with a wave and a step, in columns."""

from __future__ import annotations

import numpy as np

theta = np.array([1.0, 0.5])


def cost(x: np.ndarray) -> np.ndarray:
    """Return sin(x0) x1 + x1^2, plus 0.3 where x0 > 1.1, for ``x (2, B)``: ``(B,)``."""
    value: np.ndarray = np.sin(x[0]) * x[1] + x[1] ** 2 + np.where(x[0] > 1.1, 0.3, 0.0)
    return value


def gradient(x: np.ndarray) -> np.ndarray:
    """Return the derivative, which omits the step, ``(2, B)``."""
    return np.stack([np.cos(x[0]) * x[1], np.sin(x[0]) + 2 * x[1]])
