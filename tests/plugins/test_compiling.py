"""Executables are shared within a process, and only those used last are kept."""

import numpy as np
import pytest
from bench.plugins.backends import compiling

from bench.model import Compilations


@pytest.fixture(autouse=True)
def empty(monkeypatch):
    monkeypatch.setattr(compiling, "_known", {})
    monkeypatch.setattr(compiling, "KEPT", 3)


def power(count, n):
    """x^n, compiled for each n."""
    made = compiling.compiled(("power", n), lambda x: x**n + 0.5 * n, (np.ones(3),), False, count)
    return np.asarray(made.call(2.0 * np.ones(3)))


def test_the_executables_used_last_are_kept():
    count = Compilations(None)
    for n in (1, 2, 3):
        power(count, n)
    power(count, 1)  # so that 2 was used longest ago
    power(count, 4)
    assert count.made == 4
    power(count, 1)
    assert count.made == 4
    assert power(count, 2) == pytest.approx(2.0**2 + 1.0)  # compiled again, the same numbers
    assert count.made == 5
