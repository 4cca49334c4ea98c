"""A time budget for all calls of the user's code."""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from bench.errors import UserError

UNITS = {"ms": 1e-3, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "": 1.0}
"""Seconds per unit of a budget."""
MIN_ALARM_S, ALARM_INTERVAL_S = 1e-3, 1.0
"""Minimum delay of the alarm, and the interval at which the alarm repeats, in seconds."""
PROGRESS_INTERVAL_S = 0.2
"""Minimum time between two updates of the progress line, in seconds."""


class OutOfTime(BaseException):
    """Raised when the budget is spent, also inside a call. A BaseException, since a simulator may catch Exception."""


def parse_duration(budget: float | str) -> float:
    """Return a budget such as ``60``, ``"60s"`` or ``"2m"`` in seconds; raises :class:`UserError` if invalid.

    >>> parse_duration("2m"), parse_duration(0.5)
    (120.0, 0.5)
    """
    text = str(budget).strip()
    number = text.rstrip("abcdefghijklmnopqrstuvwxyz ")
    value = math.nan
    with suppress(ValueError, KeyError):
        value = float(number) * UNITS[text[len(number) :].strip()]
    if not (value > 0 and math.isfinite(value)):
        raise UserError(f"budget={budget} is not a duration: give seconds or a unit, budget=60s, 500ms or 2m")
    return value


class Clock:
    """Remaining budget, time spent per call, and the progress line."""

    def __init__(self, budget: float, shown: bool = False) -> None:
        self.start = time.perf_counter()
        self.budget = budget
        self.costs = self.gradients = 0
        """Number of evaluated costs and gradients, one per sample."""
        self.cost_s = self.gradient_s = 0.0
        """Seconds spent in cost and gradient calls, except the first call of each shape."""
        self._timed = {"costs": 0, "gradients": 0}
        self._shown = shown and sys.stderr.isatty()
        self._stage, self._last_shown = "", 0.0
        self._deadline = math.inf

    @property
    def spent(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self.start

    @property
    def remaining(self) -> float:
        """Remaining seconds of the budget."""
        return self.budget - self.spent

    def limit(self, share: float) -> None:
        """Limit subsequent calls to ``share`` (0 to 1) of the remaining budget."""
        self._deadline = self.spent + share * max(self.remaining, 0.0)

    def check(self) -> None:
        """Raise :class:`OutOfTime` if the budget or the limit of :meth:`limit` is spent."""
        if self.spent > min(self.budget, self._deadline):
            raise OutOfTime

    @contextmanager
    def interrupt_when_over(self) -> Iterator[None]:
        """Raise :class:`OutOfTime` inside the block when the budget is spent.

        Compiled code is interrupted only when it returns. Only the main thread can be interrupted, and only if no other
        code uses the alarm signal.
        """
        free = threading.current_thread() is threading.main_thread() and hasattr(signal, "setitimer")
        if not (free and math.isfinite(self.budget) and signal.getsignal(signal.SIGALRM) in (signal.SIG_DFL, None)):
            yield
            return

        def raise_out_of_time(number: int, frame: FrameType | None) -> None:
            raise OutOfTime

        signal.signal(signal.SIGALRM, raise_out_of_time)
        try:
            # the alarm repeats, since an exception raised in a callback may be lost
            signal.setitimer(signal.ITIMER_REAL, max(self.remaining, MIN_ALARM_S), ALARM_INTERVAL_S)
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)

    def count(self, kind: str, calls: int, taken: float, warm: bool) -> None:
        """Add ``calls`` samples of ``kind`` (costs or gradients), and their seconds if ``warm`` (nothing was compiled)."""
        if kind == "costs":
            self.costs += calls
            self.cost_s += taken if warm else 0.0
        else:
            self.gradients += calls
            self.gradient_s += taken if warm else 0.0
        self._timed[kind] += calls if warm else 0
        self._show_progress()

    def per_cost(self) -> float:
        """Return the mean seconds per cost, NaN before the first timed call."""
        return self.cost_s / self._timed["costs"] if self._timed["costs"] else math.nan

    def per_gradient(self) -> float:
        """Return the mean seconds per gradient, NaN before the first timed call."""
        return self.gradient_s / self._timed["gradients"] if self._timed["gradients"] else math.nan

    def start_stage(self, name: str) -> None:
        """Show the name of the next stage on the progress line."""
        self._stage = name
        self._show_progress(force=True)

    def _show_progress(self, force: bool = False) -> None:
        if self._shown and (force or self.spent - self._last_shown > PROGRESS_INTERVAL_S):
            self._last_shown = self.spent
            text = f"{self._stage}: {self.costs} costs, {self.gradients} gradients, {self.spent:.0f} of {self.budget:.0f} s"
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)

    def clear_progress(self) -> None:
        """Remove the progress line."""
        if self._shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
