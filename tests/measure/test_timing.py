"""The clock of estimates, with a clock of its own: medians, quartiles, repetition and memory by hand."""

import itertools
import mmap

import numpy as np
import pytest

from bench.measure import timing
from bench.measure.timing import Pause


class Clock:
    """A clock that calls move: call ``i`` of all takes the i-th of some seconds."""

    def __init__(self, seconds):
        self.now, self.called = 100.0, []
        self._seconds = iter(seconds)

    def __call__(self):
        return self.now

    def call(self, index):
        self.called.append(index)
        self.now += next(self._seconds)
        return np.array([float(index)])


@pytest.fixture
def ticking(monkeypatch):
    def make(seconds):
        clock = Clock(seconds)
        monkeypatch.setattr(timing.time, "perf_counter", clock)
        return clock

    return make


def test_median_and_quartiles_leave_the_warm_up_out(ticking):
    clock = ticking([1000.0, 3.0, 1.0, 12.0, 2.0])
    results, found = timing.timed(clock.call, 4, least_s=0.0)
    assert clock.called == [0, 0, 1, 2, 3]
    assert [float(result[0]) for result in results] == [0.0, 1.0, 2.0, 3.0]
    assert found.samples_s == (3.0, 1.0, 12.0, 2.0)
    assert (found.median_s, found.calls) == (2.5, 5)
    # quartiles of 1, 2, 3, 12 by linear interpolation
    assert found.iqr_s == pytest.approx(5.25 - 1.75)
    assert found.spread == pytest.approx(3.5 / 2.5)


def test_fast_calls_are_repeated_until_they_fill_the_time_or_are_too_many(ticking):
    clock = ticking(itertools.repeat(1.0))
    results, found = timing.timed(clock.call, 2, least_s=5.0, most=20)
    assert (len(results), len(found.samples_s)) == (2, 5)
    assert clock.called == [0, 0, 1, 0, 1, 0]
    _, found = timing.timed(ticking(itertools.repeat(1.0)).call, 2, least_s=1e9, most=3)
    assert len(found.samples_s) == 6


@pytest.mark.parametrize(("second", "made"), [(1.05, 2), (1.5, 11)])
def test_unsteady_calls_are_repeated_within_the_time_for_that(ticking, second, made):
    """Times of 1 and 1.05 have quartiles a fortieth of the median apart; 1 and 1.5 never settle, and fill 13 seconds."""
    clock = ticking(itertools.chain([1.0], itertools.cycle([1.0, second])))
    _, found = timing.timed(clock.call, 2, least_s=0.0, most=100, settle_s=13.0)
    assert len(found.samples_s) == made


def test_pauses_add_up_and_are_no_time_of_a_call(ticking):
    pause = Pause()
    clock = ticking(itertools.repeat(1.0))

    def call(index):
        for _ in range(2):
            with pause:
                clock.now += 10.0
        return clock.call(index)

    _, found = timing.timed(call, 3, least_s=0.0, pause=pause)
    assert found.samples_s == (1.0, 1.0, 1.0)
    assert pause.seconds == 4 * 2 * 10.0


@pytest.mark.skipif(np.isnan(timing.peak_memory_mb()), reason="no peak of memory on this system")
def test_peak_memory_is_in_megabytes_and_starts_anew():
    with mmap.mmap(-1, 64 << 20) as held:  # 64 MiB of the system's: the allocator may hand out what it already holds
        held.write(bytes([1]) * (64 << 20))
        timing.reset_peak_memory()
        with_it = timing.peak_memory_mb()
    timing.reset_peak_memory()
    assert with_it - timing.peak_memory_mb() == pytest.approx(64.0, abs=8.0)
