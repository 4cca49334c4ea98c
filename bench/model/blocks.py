"""Splits batches into equal blocks that fit a core's cache and compile once, and runs the blocks on several cores."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import numpy as np

MIN_COLUMNS = 512
"""Minimum columns per thread for which another thread saves time; a problem may set its own minimum."""

OfColumns = Callable[[np.ndarray], np.ndarray]
"""A function of columns, from ``(n, B)`` to ``(..., B)``."""


def cores() -> int:
    """Return the number of cores that this process may use: its CPU affinity, limited by ``OMP_NUM_THREADS``."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(available, int(limit))) if limit.isdecimal() else available


@cache
def cache_bytes() -> int:
    """Return the size in bytes of a core's level-2 cache plus its share of the level-3 cache; 4 MiB if unknown."""
    total = 0
    for index in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*"):
        try:
            level, size, sharers = ((index / name).read_text().strip() for name in ("level", "size", "shared_cpu_list"))
            if int(level) > 1:
                total += int(size.removesuffix("K")) * 1024 // _n_listed(sharers)
        except (OSError, ValueError):
            continue
    return total or 1 << 22


def _n_listed(ranges: str) -> int:
    """Return the number of items in a list of ranges such as ``0-3,8``."""
    ends = [part.split("-") for part in ranges.split(",")]
    return sum(int(end[-1]) - int(end[0]) + 1 for end in ends)


def columns_in_cache(column_bytes: int) -> int:
    """Return the power of 2 of columns that fill at most half of a core's cache, within limits.

    Batches whose sizes are powers of 2 then have blocks of one size on one or two threads, for which a program is compiled once.
    """
    columns = 1 << max(cache_bytes() // 2 // max(column_bytes, 1), 1).bit_length() - 1
    # larger blocks save no time
    return min(max(columns, MIN_COLUMNS), 1 << 14)


def n_threads(count: int, threads: int, least: int) -> int:
    """Return the number of threads for a batch: at most ``threads``, each with about ``least`` columns or more."""
    return max(1, min(threads, round(count / least)))


def block_size(count: int, most: int, grain: int, threads: int) -> int:
    """Return the number of columns per block: a multiple of ``grain``, and at most about ``most``.

    It splits the ``count`` columns into a multiple of ``threads`` blocks.
    """
    parts = math.ceil(max(1, count / most) / threads) * threads
    return max(1, math.ceil(count / parts / grain)) * grain


def evaluate(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    theta: np.ndarray,
    w: np.ndarray,
    columns: int,
    threads: int,
    lead: tuple[int, ...],
) -> np.ndarray:
    """Return ``function(theta, w)``, ``(*lead, B)``, evaluated in blocks of ``columns`` columns.

    ``theta`` is ``(d, 1)`` or ``(d, B)``. The last block is padded with copies of its last column.
    """
    count = w.shape[1]
    if count in (0, columns):
        return function(theta, w)
    result = np.empty((*lead, count))

    def block(start: int) -> None:
        part = slice(start, min(start + columns, count))
        shared = theta.shape[1] == 1
        values = function(theta if shared else padded(theta[:, part], columns), padded(w[:, part], columns))
        result[..., part] = values[..., : part.stop - part.start]

    # one pool per process: a forked child inherits the pool but not its threads
    run = _pool(threads, os.getpid()).map if threads > 1 else map
    list(run(block, range(0, count, columns)))
    return result


def padded(part: np.ndarray, columns: int) -> np.ndarray:
    """Return ``part`` padded to ``columns`` columns by repeating its last column."""
    missing = columns - part.shape[1]
    return np.concatenate([part, np.repeat(part[:, -1:], missing, axis=1)], axis=1) if missing else part


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)


def central_differences(
    function: Callable[[np.ndarray, np.ndarray], np.ndarray],
    theta: np.ndarray,
    w: np.ndarray,
    step: float | np.ndarray,
    block: int,
) -> np.ndarray:
    """Return (function(theta + h_i e_i, w) - function(theta - h_i e_i, w)) / 2h_i for all i, ``(d, B)``.

    ``theta`` is ``(d, 1)`` or ``(d, B)``, ``w (n_w, B)`` the noise, and ``step`` h, of all coordinates or of each, ``(d,)``. One
    call has the columns of several i, up to ``block``.
    """
    dim, batch = len(theta), w.shape[1]
    theta, steps = np.broadcast_to(theta, (dim, batch)), np.broadcast_to(step, (dim,))
    rows = np.empty((dim, batch))
    group = max(1, block // (2 * batch))
    for start in range(0, dim, group):
        chosen = range(start, min(start + group, dim))
        moved = np.tile(theta[:, None, :], (1, 2 * len(chosen), 1))
        for j, i in enumerate(chosen):
            moved[i, 2 * j] += steps[i]
            moved[i, 2 * j + 1] -= steps[i]
        f = function(moved.reshape(dim, -1), np.tile(w, (1, 2 * len(chosen))))
        f = f.reshape(len(chosen), 2, batch)
        rows[start : start + len(chosen)] = (f[:, 0] - f[:, 1]) / (2 * steps[start : start + len(chosen), None])
    return rows
