"""The timing protocol: warm up, time whole estimates, and return their results."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bench.model import blocks

LEAST_S = 0.005
"""Least total duration of the calls of one timing [s]; fast calls are repeated until it is reached."""
MOST = 20
"""Most runs of each call."""
STEADY = 0.1
"""Interquartile range over median up to which a timing is steady; unsteady calls are repeated."""
NOISY = 0.2
"""Interquartile range over median above which a timing is marked in tables."""


@dataclass(frozen=True)
class Timing:
    """Time of one estimate [s]: median and interquartile range over calls."""

    median_s: float
    iqr_s: float
    samples_s: tuple[float, ...] = ()
    """Time of each call [s], in order."""

    @property
    def calls(self) -> int:
        """Number of calls, including the warm-up."""
        return len(self.samples_s) + 1

    @property
    def spread(self) -> float:
        """Interquartile range over median."""
        return self.iqr_s / self.median_s


class Pause:
    """Measures time that timings exclude: use ``with pause:`` around drawing noise, for example."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._since = 0.0

    def __enter__(self) -> None:
        self._since = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.seconds += time.perf_counter() - self._since


def timed(
    call: Callable[[int], np.ndarray],
    count: int,
    least_s: float = LEAST_S,
    most: int = MOST,
    settle_s: float = 0.0,
    pause: Pause | None = None,
) -> tuple[list[np.ndarray], Timing]:
    """Return the results and the timing of ``call(0) ... call(count - 1)``, after one discarded warm-up call.

    Calls are repeated, each at most ``most`` times, until they take ``least_s`` seconds in total, and then until their
    times are :data:`STEADY` or they take ``settle_s`` seconds in total. Time within ``pause`` is subtracted. Calls must
    return finished NumPy arrays, so that no work remains on a device when the clock stops.
    """
    pause = pause or Pause()
    call(0)
    results: list[np.ndarray] = []
    seconds: list[float] = []
    while len(seconds) < count or (len(seconds) < most * count and _must_repeat(seconds, least_s, settle_s)):
        paused, start = pause.seconds, time.perf_counter()
        result = call(len(seconds) % count)
        seconds.append(time.perf_counter() - start - (pause.seconds - paused))
        if len(results) < count:
            results.append(result)
    low, median, high = np.percentile(seconds, [25, 50, 75])
    return results, Timing(float(median), float(high - low), tuple(seconds))


def _must_repeat(seconds: list[float], least_s: float, settle_s: float) -> bool:
    """Return whether to repeat calls: below ``least_s`` in total, or unsteady and below ``settle_s`` in total."""
    total = sum(seconds)
    if total < least_s:
        return True
    if total >= settle_s:
        return False
    low, median, high = np.percentile(seconds, [25, 50, 75])
    return bool(high - low > STEADY * median)


def conditions() -> dict[str, Any]:
    """Return the timing conditions: processor, available cores and threads, system load."""
    torch = sys.modules.get("torch")
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "affinity": sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "cache_bytes_per_core": blocks.cache_bytes(),
        "threads": {
            "blocks": blocks.cores(),
            "xla_per_block": 1,
            "torch": torch.get_num_threads() if torch else None,
            "environment": {name: os.environ[name] for name in sorted(os.environ) if name.endswith("_NUM_THREADS")},
        },
        "load_average": load_average(),
    }


def load_average() -> list[float] | None:
    """Return the mean number of running or waiting processes over the last 1, 5 and 15 minutes; None if unknown."""
    return list(os.getloadavg()) if hasattr(os, "getloadavg") else None


@cache
def load_at_start() -> list[float] | None:
    """Return the load average at the first call of this function; later calls return the same."""
    return load_average()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


def reset_peak_memory() -> None:
    """Reset the peak that :func:`peak_memory_mb` reports to the present memory (only on Linux)."""
    with suppress(OSError):
        # 5 resets the peak VmHWM, see proc_pid_clear_refs(5)
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory_mb() -> float:
    """Return the peak resident memory of this process since the reset, libraries included [MiB]; NaN if unknown."""
    with suppress(OSError, IndexError, ValueError):
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) / 1024
    return float("nan")
