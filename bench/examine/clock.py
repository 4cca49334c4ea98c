"""A budget whose limit of first calls does not depend on the load of the machine."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from bench.model.simulator.clock import Clock

MOST_LOST = 9.0
"""Most time lost to other programs in first calls that is not charged, in multiples of ``compile_budget``."""
SHORT_S = 0.1
"""Duration of a first call that is charged as it is [s]."""
Times = dict[str, tuple[float, float]]
"""By thread: seconds on a processor, and seconds of waiting for one."""


class ExaminationClock(Clock):
    """A clock that does not charge first calls for the time that other programs take from them, on Linux.

    A first call is charged for its wall time less :attr:`Load.lost`, so that a call that sleeps, or waits for another
    computer, reaches the limit as well.
    """

    def __init__(
        self, budget: float, shown: bool = False, calls: float = math.inf, compile_budget: float = math.inf
    ) -> None:
        super().__init__(budget, shown, calls, compile_budget)
        self.compile_limit = compile_budget
        """The limit of first calls as given [s]; ``compile_budget`` is longer by the time that they lost."""

    @contextmanager
    def interrupt_when_over(self, first: bool = False) -> Iterator[None]:
        """Raise :class:`OutOfTime` inside the block as :class:`Clock` does, for a first call after its charged time."""
        before = signal.getsignal(signal.SIGALRM) if first and hasattr(signal, "setitimer") else None
        with super().interrupt_when_over(first):
            if not first:
                yield
                return
            load = Load()
            allowed = self.compile_budget - self.compile_s
            stop = signal.getsignal(signal.SIGALRM) if hasattr(signal, "setitimer") else None

            def stop_when_spent(number: int, frame: FrameType | None) -> None:
                # the alarm repeats, so that the next one compares again
                if load.seconds - self._not_charged(load) >= allowed and callable(stop):
                    stop(number, frame)

            if callable(stop) and stop is not before:
                signal.signal(signal.SIGALRM, stop_when_spent)
            try:
                yield
            finally:
                self.compile_budget += self._not_charged(load)

    def _not_charged(self, load: Load) -> float:
        """Return the seconds of a first call that are not charged."""
        if load.seconds < SHORT_S:
            return 0.0
        rest = (1.0 + MOST_LOST) * self.compile_limit - self.compile_budget
        return min(load.lost, rest) if rest > 0.0 else 0.0


class Load:
    """The time that other programs take from this process and its children, from now on."""

    def __init__(self) -> None:
        self._start, self._before = time.perf_counter(), thread_times()

    @property
    def seconds(self) -> float:
        """Wall time so far."""
        return time.perf_counter() - self._start

    @property
    def lost(self) -> float:
        """Seconds by which the work so far took longer than on an idle machine; 0 where unknown."""
        running = waiting = 0.0
        for thread, now in thread_times().items():
            before = self._before.get(thread, (0.0, 0.0))
            running += max(now[0] - before[0], 0.0)
            waiting += max(now[1] - before[1], 0.0)
        processors = len(os.sched_getaffinity(0)) if waiting else 1
        return lost_time(running, waiting, self.seconds, processors)


def lost_time(running: float, waiting: float, seconds: float, processors: int) -> float:
    """Return by how many of ``seconds`` a program is later than on an idle machine.

    ``running`` and ``waiting`` are the sums over its threads of the seconds on a processor and of the seconds in which a
    thread was ready and had none. On an idle machine its threads run on as many of the processors as they need.

    >>> lost_time(running=1.0, waiting=3.0, seconds=4.0, processors=2)  # one thread that gets a quarter of a processor
    3.0
    >>> lost_time(running=8.0, waiting=8.0, seconds=4.0, processors=2)  # four threads that have both processors
    0.0
    >>> lost_time(running=0.0, waiting=0.0, seconds=4.0, processors=2)  # it sleeps
    0.0
    """
    ready = running + waiting
    wanted = min(ready, processors * seconds)
    if wanted <= 0.0:
        return 0.0
    return max(0.0, min(seconds, ready) * (1.0 - running / wanted))


def thread_times() -> Times:
    """Return the times of the living threads of this process and of its children; empty where unknown."""
    times: Times = {}
    processes = [str(os.getpid())]
    for process in processes:  # which grows by the children of each
        for thread in Path(f"/proc/{process}/task").glob("*"):
            try:
                running, waiting, _ = (thread / "schedstat").read_text().split()
                times[str(thread)] = int(running) * 1e-9, int(waiting) * 1e-9
                processes += (thread / "children").read_text().split()
            except (OSError, ValueError):
                continue  # the thread has ended
    return times
