"""Long batches in parts of one length, so that a compiling backend compiles once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def in_columns(function: Callable[[np.ndarray], np.ndarray], w: np.ndarray, columns: int) -> np.ndarray:
    """Return ``function(w)``, ``(..., B)``, for noise ``w (n_w, B)`` taken ``columns`` at a time.

    The last part is filled up with copies of its last column, whose results are dropped.
    """
    count = w.shape[1]
    short = -count % columns
    whole = np.concatenate([w, np.repeat(w[:, -1:], short, axis=1)], axis=1) if short else w
    parts = [function(whole[:, i : i + columns]) for i in range(0, whole.shape[1], columns)]
    return np.concatenate(parts, axis=-1)[..., :count]
