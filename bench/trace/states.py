"""Aligns values of a rollout's steps with values of its states."""

from __future__ import annotations

import numpy as np

from bench.model import Array


def per_state(values: Array) -> np.ndarray:
    """Return values of the steps ``(T,)`` extended to the states, ``(T + 1,)``, with NaN for the last state."""
    return np.append(np.asarray(values, dtype=np.float64), np.nan)
