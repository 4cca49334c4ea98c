"""Counter-based common random numbers: the same noise for every estimator and backend."""

from __future__ import annotations

import zlib
from functools import lru_cache

import numpy as np


@lru_cache(maxsize=2)
def shared(seed: int, scene: str, repeats: int, samples: int, width: int) -> np.ndarray:
    """Return :func:`draw` for cells, kept for the next cell that asks for the same."""
    return draw(seed, scene, repeats, samples, width, "cells")


def draw(seed: int, scene: str, repeats: int, samples: int, width: int, stream: str) -> np.ndarray:
    """Draw standard normal noise ``(repeats, samples, width)``, read-only.

    Repeat r comes from a Philox generator keyed only by (seed, stream, scene, r): adding repeats, or samples to a
    repeat, keeps the earlier numbers. Stored component-first, so that flattening to ``(width, R * N)`` copies nothing.
    """
    block = np.empty((width, repeats, samples))
    for r in range(repeats):
        key = np.random.SeedSequence([seed, zlib.crc32(stream.encode()), zlib.crc32(scene.encode()), r])
        block[:, r, :] = np.random.Generator(np.random.Philox(key)).standard_normal((samples, width)).T
    # cells share the array
    block.setflags(write=False)
    return np.moveaxis(block, 0, -1)
