"""Intervals agree with SciPy's, and keep working where SciPy's raise or warn."""

import math

import numpy as np
import pytest
from scipy import stats

from bench.measure import performance

ROUNDING = 1e-14
"""Relative difference of two formulas of the same quantity."""


@pytest.mark.parametrize("trials", [1, 2, 3, 10, 37, 1000])
def test_wilson_interval_is_scipys(trials):
    for successes in range(0, trials + 1, max(1, trials // 40)):
        interval = stats.binomtest(successes, trials).proportion_ci(method="wilson")
        assert performance.wilson(successes, trials) == pytest.approx(
            (interval.low, interval.high), rel=ROUNDING, abs=ROUNDING
        )


def test_wilson_interval_without_trials_is_everything():
    assert performance.wilson(0, 0) == (0.0, 1.0)


def test_average_runtime_of_few_searches_is_covered():
    """A plain percentile interval of 8 searches contains the mean in 87.5% of these sets."""
    random, inside = np.random.default_rng([1, 8]), 0
    for _ in range(400):
        spent = np.exp(0.5 * random.standard_normal(8))
        low, high = performance.runtime_interval(spent, np.ones(8, dtype=bool))
        inside += low <= math.exp(0.125) <= high
    assert inside / 400 > 0.91


def test_bootstrap_of_single_values_is_their_statistic():
    assert performance.bootstrap([np.array([2.0]), np.array([4.0])], lambda p: float(np.mean(p))) == (3.0, 3.0)
