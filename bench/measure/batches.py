"""Splits long batches into parts of equal length, so that a compiling backend compiles once."""

from __future__ import annotations

import numpy as np

from bench.model.blocks import OfColumns, padded

N_COLUMNS = 4096
"""Columns of every batch of a reference, constant so that a compiling backend compiles once, and fewer if few samples are drawn."""


def in_columns(function: OfColumns, w: np.ndarray, columns: int) -> np.ndarray:
    """Return ``function(w)``, ``(..., B)``, for noise ``w (n_w, B)``, evaluated ``columns`` at a time.

    The last part is padded with copies of its last column, whose results are dropped.
    """
    count = w.shape[1]
    parts = [function(padded(w[:, i : i + columns], columns)) for i in range(0, count, columns)]
    return np.concatenate(parts, axis=-1)[..., :count]
