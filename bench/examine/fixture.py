"""A pytest plugin: ``def test_gradient(examine): examine(cost, theta, grad=gradient)`` fails with the full report.

pytest loads it wherever the package is installed. ``--bench-update`` writes baselines again.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that writes baselines again."""
    parser.addoption("--bench-update", action="store_true", help="write the baselines of examine again")


@pytest.fixture
def examine(request: pytest.FixtureRequest, record_property: Callable[[str, object], None]) -> Callable[..., Any]:
    """Return :func:`bench.examine` as a function that fails the test unless the status is 0.

    It also accepts ``baseline``, a file to compare with. pytest's own JUnit file gets the cause and the size of the
    error as properties.
    """

    from bench.examine import examination  # pytest starts without it

    def examined(cost: Callable[..., Any], theta: Any, *, baseline: str | Path = "", **settings: Any) -> Any:
        report = examination.examine(cost, theta, **{"progress": False, **settings})
        if baseline and request.config.getoption("--bench-update"):
            Path(baseline).expanduser().unlink(missing_ok=True)
        report = report.compared(baseline) if baseline else report
        for name in ("derivative", "cause", "size"):
            record_property(f"{report.name} {name}", getattr(report, name))
        report.assert_right()
        return report

    return examined
