"""The measuring protocol: warm up, time whole estimates, keep their results."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Timing:
    """Seconds for one estimate: median and interquartile range over calls."""

    median_s: float
    iqr_s: float
    samples_s: tuple[float, ...] = ()
    """Of each call, in order."""


def timed(call: Callable[[int], np.ndarray], count: int) -> tuple[list[np.ndarray], Timing]:
    """Results and seconds of ``call(0) ... call(count - 1)``, after one warm-up call that is thrown away.

    Calls must return finished NumPy arrays, so that no work is left on a device when the clock stops.
    """
    call(0)
    results, seconds = [], []
    for index in range(count):
        start = time.perf_counter()
        results.append(call(index))
        seconds.append(time.perf_counter() - start)
    low, median, high = np.percentile(seconds, [25, 50, 75])
    return results, Timing(float(median), float(high - low), tuple(seconds))


def reset_peak_memory() -> None:
    """Make :func:`peak_memory_mb` count from now (Linux; elsewhere nothing happens)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory_mb() -> float:
    """Largest resident set of this process since the reset, libraries included, in MB; NaN where it is not known."""
    with suppress(OSError, IndexError, ValueError):
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) / 1024
    return float("nan")
