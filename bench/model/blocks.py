"""Batches split into equal blocks that fit a core's cache, need one compilation, and are shared among the cores."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import numpy as np

LEAST = 512
"""Fewest columns for which it pays to give a part of a batch to another core, unless a problem says otherwise."""
MOST = 1 << 14
"""Columns beyond which a larger block saves nothing."""


def cores() -> int:
    """Return the number of cores that this process may use: those it is bound to, at most ``OMP_NUM_THREADS``."""
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    allowed = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(own, int(allowed))) if allowed.isdecimal() else own


@cache
def cache_bytes() -> int:
    """Return the bytes a core can keep near: its second-level cache and its share of the third; 4 MiB if unknown."""
    total = 0
    for index in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*"):
        try:
            level, size, sharers = ((index / name).read_text().strip() for name in ("level", "size", "shared_cpu_list"))
            if int(level) > 1:
                total += int(size.removesuffix("K")) * 1024 // _count(sharers)
        except (OSError, ValueError):
            continue
    return total or 1 << 22


def _count(ranges: str) -> int:
    """Return how many numbers a list such as ``0-3,8`` holds."""
    ends = [part.split("-") for part in ranges.split(",")]
    return sum(int(end[-1]) - int(end[0]) + 1 for end in ends)


def fitting(column_bytes: int, grain: int) -> int:
    """Return the columns of a block that fills half of a core's cache, a multiple of ``grain``."""
    wanted = cache_bytes() // 2 // max(column_bytes, 1)
    return max(1, min(max(wanted, LEAST), MOST) // grain) * grain


def sharing(count: int, threads: int, least: int) -> int:
    """Return how many threads share a batch: as many as get about ``least`` columns each, at least one."""
    return max(1, min(threads, round(count / least)))


def size(count: int, most: int, grain: int, threads: int) -> int:
    """Return the columns of each of a batch's equal blocks: a multiple of ``grain``, about ``most`` at the most.

    The number of blocks is a multiple of ``threads``.
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
    """Evaluate ``function(theta, w)``, ``(*lead, B)``, in blocks of ``columns`` columns.

    ``theta`` is ``(d, 1)`` or ``(d, B)``. The last block is filled up with copies of its last column.
    """
    count = w.shape[1]
    if count in (0, columns):
        return function(theta, w)
    result = np.empty((*lead, count))

    def block(start: int) -> None:
        part = slice(start, min(start + columns, count))
        shared = theta.shape[1] == 1
        found = function(theta if shared else _filled(theta[:, part], columns), _filled(w[:, part], columns))
        result[..., part] = found[..., : part.stop - part.start]

    _share(block, range(0, count, columns), threads)
    return result


def _share(block: Callable[[int], None], starts: Sequence[int], threads: int) -> None:
    """Call ``block`` with each start, in this thread and in ``threads - 1`` others."""
    left = deque(starts)

    def work() -> None:
        while left:
            try:
                start = left.popleft()
            except IndexError:  # another thread was faster
                return
            block(start)

    helpers = min(threads, len(starts)) - 1
    # a pool per process: a forked child inherits the pool, but not its threads
    begun = [_pool(threads - 1, os.getpid()).submit(work) for _ in range(helpers)] if helpers > 0 else []
    try:
        work()
    finally:
        left.clear()
        # a thread that has not woken up yet has nothing left to do
        failed = [helper.exception() for helper in begun if not helper.cancel()]
    for error in filter(None, failed):
        raise error


def _filled(part: np.ndarray, columns: int) -> np.ndarray:
    short = columns - part.shape[1]
    return np.concatenate([part, np.repeat(part[:, -1:], short, axis=1)], axis=1) if short else part


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)
