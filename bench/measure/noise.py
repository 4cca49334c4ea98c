"""Draws common random numbers: the same noise for every estimator and backend, from counter-based generators."""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterator
from functools import lru_cache

import numpy as np

REVISION = 1
"""Raised when a stored number that this module decides moves."""

HELD = 1 << 22
"""Most normal numbers that a cell stores in memory (32 MiB). A cell that needs more draws them in parts."""


def shared(seed: int, scene: str, repeats: int, samples: int, width: int) -> np.ndarray:
    """Return the noise of cells, see :func:`draw`, in an array of the caller's own.

    Up to :data:`HELD` numbers are kept for the next cell with the same arguments, which gets a copy: read-only does not
    bind torch, and a cell that writes into its noise changes no other cell.
    """
    if repeats * samples * width > HELD:
        return draw(seed, scene, repeats, samples, width, "cells")
    own = _kept(seed, scene, repeats, samples, width).copy(order="K")
    own.setflags(write=False)
    return own


@lru_cache(maxsize=2)
def _kept(seed: int, scene: str, repeats: int, samples: int, width: int) -> np.ndarray:
    """Return the noise that cells get copies of."""
    return draw(seed, scene, repeats, samples, width, "cells")


def draw(seed: int, scene: str, repeats: int, samples: int, width: int, stream: str) -> np.ndarray:
    """Return standard normal noise ``(repeats, samples, width)``, read-only.

    Repeat r comes from a Philox generator whose key depends only on (seed, stream, scene, r), so more repeats or more
    samples per repeat do not change the earlier numbers. The array is stored component-first, so that flattening it to
    ``(width, R * N)`` copies nothing.
    """
    block = np.empty((width, repeats, samples))
    for r in range(repeats):
        block[:, r, :] = _generator(seed, scene, r, stream).standard_normal((samples, width)).T
    # estimators take noise, and do not change it
    block.setflags(write=False)
    return np.moveaxis(block, 0, -1)


def parts(seed: int, scene: str, repeat: int, samples: int, width: int, stream: str) -> Iterator[np.ndarray]:
    """Yield the numbers of one repeat of :func:`draw` in parts ``(width, b)`` of at most :data:`HELD` numbers.

    The sizes of the parts depend only on the width, so sums over parts do not depend on the machine.
    """
    generator = _generator(seed, scene, repeat, stream)
    columns = max(1, HELD // max(width, 1))
    for start in range(0, samples, columns):
        yield np.ascontiguousarray(generator.standard_normal((min(columns, samples - start), width)).T)


@lru_cache(maxsize=64)
def seconds(seed: int, scene: str, samples: int, width: int) -> float:
    """Return the time to draw the noise of one estimate [s], extrapolated from its first part."""
    started = time.perf_counter()
    part = next(parts(seed, scene, 0, samples, width, "cells"))
    return float((time.perf_counter() - started) * samples / part.shape[1])


def _generator(seed: int, scene: str, repeat: int, stream: str) -> np.random.Generator:
    key = np.random.SeedSequence([seed, zlib.crc32(stream.encode()), zlib.crc32(scene.encode()), repeat])
    return np.random.Generator(np.random.Philox(key))
