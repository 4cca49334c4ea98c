"""A pytest plugin: ``def test_gradient(examine): examine(cost, theta, grad=gradient)`` fails with the full report.

pytest loads it wherever the package is installed. ``--bench-update`` writes baselines again.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bench.examine import UPDATE


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that writes baselines."""
    parser.addoption(UPDATE, action="store_true", help="write the baselines of examine, also where a gradient is wrong")


@pytest.fixture
def examine(record_property: Callable[[str, object], None], request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Return :func:`bench.examine` as a function that fails the test unless the status is 0.

    It also accepts ``baseline``, a file to compare with; a missing one is written only if the status is 0, with a warning, or
    with ``--bench-update``. pytest's own JUnit file gets the cause and the size of the error as properties.
    """
    from bench.examine import examination  # pytest starts without it

    def examined(cost: Callable[..., Any], theta: Any, *, baseline: str | Path = "", **settings: Any) -> Any:
        report = examination.examine(cost, theta, **{"progress": False, **settings})
        if baseline:
            update, is_new = request.config.getoption(UPDATE, default=False), not Path(baseline).exists()
            report = report.compared(baseline, update)
            if is_new and not update:
                warnings.warn(f"baseline={'; '.join(report.changes)}", stacklevel=2)
        for name in ("derivative", "cause", "size"):
            record_property(f"{report.name} {name}", getattr(report, name))
        report.assert_right()
        return report

    return examined
