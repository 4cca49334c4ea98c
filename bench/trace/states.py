"""Arrays along a rollout: aligns values of the steps with values of the states."""

from __future__ import annotations

import numpy as np

from bench.model import Array


def per_state(values: Array) -> np.ndarray:
    """Extend values of the steps ``(T,)`` to the states, ``(T + 1,)``, by NaN for the last state, which has no step."""
    return np.append(np.asarray(values, dtype=np.float64), np.nan)
