"""A budget of time and calls for all calls of the user's code."""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from bench.errors import UserError

UNITS = {"ms": 1e-3, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "": 1.0}
"""Seconds per unit of a budget."""
KINDS = ("costs", "gradients")
"""What is counted and timed."""
MIN_ALARM_S, ALARM_INTERVAL_S = 1e-3, 1.0
"""Minimum delay of the alarm, and the interval at which the alarm repeats, in seconds."""
PROGRESS_INTERVAL_S = 0.2
"""Minimum time between two updates of the progress line, in seconds."""


class OutOfTime(BaseException):
    """Raised when the budget is spent, also inside a call. A BaseException, since a simulator may catch Exception."""


def parse_duration(budget: float | str, what: str = "budget") -> float:
    """Return a budget such as ``60``, ``"60s"`` or ``"2m"`` in seconds; raises :class:`UserError` if invalid.

    >>> parse_duration("2m"), parse_duration("2M"), parse_duration(0.5)
    (120.0, 120.0, 0.5)
    """
    text = str(budget).strip().lower()
    number = text.rstrip("abcdefghijklmnopqrstuvwxyz ")
    value = math.nan
    with suppress(ValueError, KeyError):
        value = float(number) * UNITS[text[len(number) :].strip()]
    if not (value > 0 and math.isfinite(value)):
        raise UserError(f"{what}={budget} is not a duration: give seconds or a unit, {what}=60s, 500ms or 2m")
    return value


class Clock:
    """Remaining budget, time spent per call, and the progress line.

    ``budget`` is the time for warm calls and everything between them [s]. The first call of each kind and shape may
    compile: its time counts against ``compile_budget`` instead. ``calls`` limits the number of costs and gradients
    together. With a limit of calls and no finite ``budget``, no decision depends on time.
    """

    def __init__(
        self, budget: float, shown: bool = False, calls: float = math.inf, compile_budget: float = math.inf
    ) -> None:
        self.start = time.perf_counter()
        self.budget, self.calls, self.compile_budget = budget, calls, compile_budget
        self.counts: Counter[str] = Counter()
        """Number of evaluated ``costs`` and ``gradients``, one per sample."""
        self.compile_s = 0.0
        """Seconds spent in the first call of each kind and shape."""
        self._timed: Counter[str] = Counter()
        self._seconds = dict.fromkeys(KINDS, 0.0)
        self._shown = shown and sys.stderr.isatty()
        self._stage, self._last_shown = "", 0.0
        self._deadline, self._last_call = math.inf, math.inf
        self.is_interrupted = False
        """Whether the running call was interrupted: compiled code that called back may have made another error of it, or none."""

    @property
    def spent(self) -> float:
        """Seconds since the start, without first calls."""
        return self.elapsed - self.compile_s

    @property
    def elapsed(self) -> float:
        """Seconds since the start, including first calls."""
        return time.perf_counter() - self.start

    @property
    def used(self) -> int:
        """Number of costs and gradients computed so far."""
        return self.counts.total()

    @property
    def remaining(self) -> float:
        """Remaining seconds of the budget."""
        return self.budget - self.spent

    def can_afford(self, costs: float, gradients: float = 0.0, share: float = 1.0) -> bool:
        """Return whether these numbers of costs and gradients fit a share (0 to 1) of the remaining budget."""
        if costs + gradients > share * (self.calls - self.used):
            return False
        if math.isinf(self.budget):
            return True
        each, slope = map(self.seconds_per, KINDS)
        each = 0.0 if math.isnan(each) else each
        slope = 4.0 * each if math.isnan(slope) else slope
        return costs * each + gradients * slope <= share * self.remaining

    def limit(self, share: float) -> None:
        """Limit subsequent calls to ``share`` (0 to 1) of the remaining budget."""
        self._deadline = self.spent + share * max(self.remaining, 0.0)
        self._last_call = self.used + share * max(self.calls - self.used, 0.0)

    def check(self, calls: int = 0) -> None:
        """Raise :class:`OutOfTime` if the budget or the limit of :meth:`limit` is spent, or ``calls`` would exceed it."""
        if self.spent > min(self.budget, self._deadline):
            raise OutOfTime
        if self.used + calls > min(self.calls, self._last_call):
            raise OutOfTime

    @contextmanager
    def interrupt_when_over(self, first: bool = False) -> Iterator[None]:
        """Raise :class:`OutOfTime` inside the block when the budget is spent, or ``compile_budget`` for a first call.

        Compiled code is interrupted only when it returns or calls back. Whatever it makes of the interruption, the block
        ends with :class:`OutOfTime`, and its result does not count. Only the main thread can be interrupted, and only if no other
        code uses the alarm signal.
        """
        allowed = self.compile_budget - self.compile_s if first else self.remaining
        began = time.perf_counter()
        is_free = threading.current_thread() is threading.main_thread() and hasattr(signal, "setitimer")
        is_free = is_free and math.isfinite(allowed)
        is_free = is_free and signal.getsignal(signal.SIGALRM) in (signal.SIG_DFL, None)

        def raise_out_of_time(number: int, frame: FrameType | None) -> None:
            self.is_interrupted = True
            raise OutOfTime

        self.is_interrupted = False
        try:
            if is_free:
                signal.signal(signal.SIGALRM, raise_out_of_time)
                # the alarm repeats, since an exception raised in a callback may be lost
                signal.setitimer(signal.ITIMER_REAL, max(allowed, MIN_ALARM_S), ALARM_INTERVAL_S)
            yield
            if self.is_interrupted:
                raise OutOfTime
        finally:
            if is_free:
                signal.setitimer(signal.ITIMER_REAL, 0.0)
                signal.signal(signal.SIGALRM, signal.SIG_DFL)
            if first:
                self.compile_s += time.perf_counter() - began

    def count(self, kind: str, calls: int, taken: float, warm: bool) -> None:
        """Add ``calls`` samples of ``kind`` (costs or gradients), and their seconds if ``warm`` (nothing was compiled)."""
        self.counts[kind] += calls
        self._timed[kind] += calls * warm
        self._seconds[kind] += taken * warm
        self._show_progress()

    def seconds_per(self, kind: str) -> float:
        """Return the mean seconds per cost or gradient, without the first call of each shape; NaN before the first timed call."""
        return self._seconds[kind] / self._timed[kind] if self._timed[kind] else math.nan

    @contextmanager
    def stage(self, name: str, left_out: list[str], share: float = 1.0) -> Iterator[None]:
        """Run a stage within a share (0 to 1) of the remaining budget; where that ends before, its name is left out."""
        self._stage = name
        self._show_progress(force=True)
        self.limit(share)
        try:
            yield
        except OutOfTime:
            left_out.append(name)
        finally:
            self.limit(1.0)

    def _show_progress(self, force: bool = False) -> None:
        if self._shown and (force or self.elapsed - self._last_shown > PROGRESS_INTERVAL_S):
            self._last_shown = self.elapsed
            limit = f" of {self.calls:,.0f} calls" * math.isfinite(self.calls)
            limit += f", {self.spent:.0f} s" + f" of {self.budget:.0f} s" * math.isfinite(self.budget)
            text = f"{self._stage}: {self.counts['costs']} costs, {self.counts['gradients']} gradients{limit}"
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)

    def clear_progress(self) -> None:
        """Remove the progress line."""
        if self._shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
