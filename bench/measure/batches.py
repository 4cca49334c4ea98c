"""Splits long batches into parts of equal length, so that a compiling backend compiles once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def in_columns(function: Callable[[np.ndarray], np.ndarray], w: np.ndarray, columns: int) -> np.ndarray:
    """Return ``function(w)``, ``(..., B)``, for noise ``w (n_w, B)``, evaluated ``columns`` at a time.

    The last part is padded with copies of its last column, whose results are dropped.
    """
    count = w.shape[1]
    padded = np.pad(w, ((0, 0), (0, -count % columns)), mode="edge")
    parts = [function(padded[:, i : i + columns]) for i in range(0, padded.shape[1], columns)]
    return np.concatenate(parts, axis=-1)[..., :count]
