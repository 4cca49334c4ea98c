"""One budget in seconds for everything, counted at every call of the user's code."""

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
"""Units of a budget, in seconds."""


LEAST, AGAIN = 1e-3, 1.0
"""Seconds of the alarm at least, and until it rings again."""


class OutOfTime(BaseException):
    """Raised when the budget is over, also inside a call: no Exception, which a simulator may catch."""


def seconds(budget: float | str) -> float:
    """Return a budget in seconds: ``60``, ``"60s"``, ``"2m"``; raises :class:`UserError` otherwise.

    >>> seconds("2m"), seconds(0.5)
    (120.0, 0.5)
    """
    text = str(budget).strip()
    number = text.rstrip("abcdefghijklmnopqrstuvwxyz ")
    value = math.nan
    with suppress(ValueError, KeyError):
        value = float(number) * UNITS[text[len(number) :].strip()]
    if not (value > 0 and math.isfinite(value)):
        raise UserError(f"budget={budget} is no time: give seconds or a unit, budget=60s, 500ms or 2m")
    return value


class Clock:
    """The time that is left, what the calls have taken, and the line that shows progress."""

    def __init__(self, budget: float, shown: bool = False) -> None:
        self.start = time.perf_counter()
        self.budget = budget
        self.costs = self.gradients = 0
        """Calls of one sample each."""
        self.cost_s = self.gradient_s = 0.0
        """Seconds in them, the first call of each shape left out."""
        self._timed = {"costs": 0, "gradients": 0}
        self._shown = shown and sys.stderr.isatty()
        self._stage, self._said = "", 0.0
        self._until = math.inf

    @property
    def spent(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self.start

    @property
    def left(self) -> float:
        """Seconds that are left."""
        return self.budget - self.spent

    def allow(self, share: float) -> None:
        """Let the calls that follow take this share of what is left, and no more."""
        self._until = self.spent + share * max(self.left, 0.0)

    def check(self) -> None:
        """Raise :class:`OutOfTime` when the time is over."""
        if self.spent > min(self.budget, self._until):
            raise OutOfTime

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Raise :class:`OutOfTime` inside the block when the budget ends in it.

        A call that runs compiled code is interrupted when that returns. Only the main thread can be interrupted, and only
        where nobody else uses the alarm.
        """
        free = threading.current_thread() is threading.main_thread() and hasattr(signal, "setitimer")
        if not (free and math.isfinite(self.budget) and signal.getsignal(signal.SIGALRM) in (signal.SIG_DFL, None)):
            yield
            return

        def over(number: int, frame: FrameType | None) -> None:
            raise OutOfTime

        signal.signal(signal.SIGALRM, over)
        try:
            # the alarm repeats, in case what it raises is lost in a callback
            signal.setitimer(signal.ITIMER_REAL, max(self.left, LEAST), AGAIN)
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)

    def count(self, kind: str, calls: int, taken: float, warm: bool) -> None:
        """Count calls, and their time where they compiled nothing."""
        if kind == "costs":
            self.costs += calls
            self.cost_s += taken if warm else 0.0
        else:
            self.gradients += calls
            self.gradient_s += taken if warm else 0.0
        self._timed[kind] += calls if warm else 0
        self._progress()

    def per_cost(self) -> float:
        """Seconds of one cost, NaN before any was timed."""
        return self.cost_s / self._timed["costs"] if self._timed["costs"] else math.nan

    def per_gradient(self) -> float:
        """Seconds of one gradient, NaN before any was timed."""
        return self.gradient_s / self._timed["gradients"] if self._timed["gradients"] else math.nan

    def stage(self, name: str) -> None:
        """Say what comes next."""
        self._stage = name
        self._progress(force=True)

    def _progress(self, force: bool = False) -> None:
        if self._shown and (force or self.spent - self._said > 0.2):
            self._said = self.spent
            text = f"{self._stage}: {self.costs} costs, {self.gradients} gradients, {self.spent:.0f} of {self.budget:.0f} s"
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Take the progress line away."""
        if self._shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
