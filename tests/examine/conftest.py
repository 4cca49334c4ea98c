"""A clock for examinations that other programs do not move."""

import pytest


@pytest.fixture
def now(monkeypatch):
    """The time of a clock that only costs move, so that no other program counts: ``now[0] += seconds``."""
    seconds = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: seconds[0])
    return seconds
