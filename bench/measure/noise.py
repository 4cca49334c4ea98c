"""Draws common random numbers: the same noise for every estimator and backend, from counter-based generators."""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from bench.model.design import IID, Design

REVISION = 1
"""Raised when a stored number that this module decides moves."""

BITS = 30
"""Binary digits of a coordinate of a Sobol point."""
HELD = 1 << 22
"""Most normal numbers that a cell stores in memory (32 MiB). A cell that needs more draws them in parts."""
KEPT = 4 * HELD
"""Most normal numbers that are kept for cells and references with the same noise."""

_kept: dict[tuple[object, ...], np.ndarray] = {}


def shared(
    seed: int, scene: str, repeats: int, samples: int, width: int, design: Design = IID, stream: str = "cells"
) -> np.ndarray:
    """Return the noise of :func:`draw` in an array of the caller's own.

    It is kept for the next call with the same arguments, which gets a copy: read-only does not bind torch, and a cell that
    writes into its noise changes no other cell. The oldest noise makes room, and noise beyond :data:`HELD` is not kept.
    """
    given = (seed, scene, repeats, samples, width, stream, design)
    block = _kept.pop(given, None)
    if block is None:
        block = draw(*given)
        if block.size > HELD:
            return block
        # at most 1000 arrays, since their sizes are summed for each new one
        while len(_kept) >= 1000 or sum(kept.size for kept in _kept.values()) > KEPT - block.size:
            del _kept[next(iter(_kept))]
    _kept[given] = block
    own = block.copy(order="K")
    own.setflags(write=False)
    return own


def draw(
    seed: int, scene: str, repeats: int, samples: int, width: int, stream: str, design: Design = IID
) -> np.ndarray:
    """Return standard normal noise ``(repeats, samples, width)``, read-only.

    Repeat r comes from a Philox generator whose key depends only on (seed, stream, scene, r), so more repeats or more
    samples per repeat do not change the earlier numbers. N mirrored samples are the first N / 2 draws and their mirror
    images. The array is stored component-first, so that flattening it to ``(width, R * N)`` copies nothing.
    """
    block = np.empty((width, repeats, samples))
    for r in range(repeats):
        block[:, r, :] = samples_of(_generator(seed, scene, r, stream), samples, width, design).T
    # estimators take noise, and do not change it
    block.setflags(write=False)
    return np.moveaxis(block, 0, -1)


def parts(
    seed: int, scene: str, repeat: int, samples: int, width: int, stream: str, design: Design = IID
) -> Iterator[np.ndarray]:
    """Yield the numbers of one repeat of :func:`draw` in parts ``(width, b)`` of at most :data:`HELD` numbers.

    A unit of the design is never cut, so a part has more numbers where a unit has. The sizes of the parts depend only on
    the width and the design, so sums over parts do not depend on the machine.
    """
    generator = _generator(seed, scene, repeat, stream)
    columns = max(1, HELD // max(width, 1) // design.unit) * design.unit
    for start in range(0, samples, columns):
        yield np.ascontiguousarray(samples_of(generator, min(columns, samples - start), width, design).T)


def samples_of(generator: np.random.Generator, samples: int, width: int, design: Design) -> np.ndarray:
    """Return the next ``samples`` draws of a design, whole units but the last, ``(samples, width)``."""
    count = samples // 2 if design.mirrored else samples
    drawn = generator.standard_normal((count, width)) if design.draws != "sobol" else np.empty((count, width))
    for start in range(0, count, design.block) if design.draws != "iid" else ():
        part = drawn[start : start + design.block]
        if design.draws == "orthogonal":
            part[:, : design.width] = orthogonal(part[:, : design.width])
        else:
            part[:, : design.width] = sobol(generator, len(part), design.width)
            part[:, design.width :] = generator.standard_normal(part[:, design.width :].shape)
    if not design.mirrored:
        return drawn
    mirrored = -drawn
    mirrored[:, width - design.held :] = drawn[:, width - design.held :]
    return np.stack([drawn, mirrored], axis=1).reshape(samples, width)


def orthogonal(normal: np.ndarray) -> np.ndarray:
    """Return orthogonal vectors ``(m, d)``, m <= d, from independent normal vectors, whose lengths they have.

    Each is standard normal: by Gram and Schmidt, it is uniform in direction given those before it, and a normal vector's length
    does not depend on its direction.
    """
    q, r = np.linalg.qr(normal.T)
    vectors = (q * np.sign(np.diag(r))).T
    return np.asarray(vectors * np.linalg.norm(normal, axis=1, keepdims=True))


def sobol(generator: np.random.Generator, count: int, width: int) -> np.ndarray:
    """Return a scrambled Sobol set of ``count`` standard normal vectors ``(count, width)``; ``count`` is a power of 2.

    A point is uniform within its cell of width 2^-:data:`BITS`, so each vector is exactly standard normal (scrambling:
    Matousek 1998, as in SciPy).
    """
    from scipy.special import ndtri
    from scipy.stats import qmc

    points = qmc.Sobol(width, scramble=True, bits=BITS, rng=generator).random(count)
    inside = generator.random(points.shape)
    return np.asarray(ndtri(np.clip(points + 2.0**-BITS * inside, 2.0**-53, 1.0 - 2.0**-53)))


@lru_cache(maxsize=64)
def seconds(seed: int, scene: str, samples: int, width: int, design: Design = IID) -> float:
    """Return the time to draw the noise of one estimate [s], extrapolated from its first part."""
    started = time.perf_counter()
    part = next(parts(seed, scene, 0, samples, width, "cells", design))
    return float((time.perf_counter() - started) * samples / part.shape[1])


def _generator(seed: int, scene: str, repeat: int, stream: str) -> np.random.Generator:
    key = np.random.SeedSequence([seed, zlib.crc32(stream.encode()), zlib.crc32(scene.encode()), repeat])
    return np.random.Generator(np.random.Philox(key))
