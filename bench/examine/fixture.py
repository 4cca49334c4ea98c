"""A pytest fixture: ``def test_gradient(examine): examine(cost, theta, grad=gradient)`` fails with the full report.

In a project's ``conftest.py``: ``pytest_plugins = ["bench.examine.fixture"]``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bench.examine.examination import examine as _examine
from bench.examine.report import Report


@pytest.fixture
def examine(record_property: Callable[[str, object], None]) -> Callable[..., Report]:
    """Return :func:`bench.examine` as a function that fails the test unless the status is 0.

    It also accepts ``baseline``, a file to compare with. pytest's own JUnit file gets the cause and the size of the
    error as properties.
    """

    def examined(cost: Callable[..., Any], theta: Any, *, baseline: str | Path = "", **settings: Any) -> Report:
        report = _examine(cost, theta, **{"progress": False, **settings})
        report = report.compared(baseline) if baseline else report
        for name in ("derivative", "cause", "size"):
            record_property(f"{report.name} {name}", getattr(report, name))
        report.assert_right()
        return report

    return examined
