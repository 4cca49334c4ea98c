"""A pytest fixture: ``def test_gradient(examine): examine(cost, theta, grad=gradient)`` fails with the full report.

In a project's ``conftest.py``: ``pytest_plugins = ["bench.examine.fixture"]``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from bench.examine.examination import examine as _examine
from bench.examine.report import Report


@pytest.fixture
def examine() -> Callable[..., Report]:
    """Return :func:`bench.examine` as a function that fails the test if the report has a problem."""

    def examined(cost: Callable[..., Any], theta: Any, **settings: Any) -> Report:
        report = _examine(cost, theta, **{"progress": False, **settings})
        report.assert_right()
        return report

    return examined
