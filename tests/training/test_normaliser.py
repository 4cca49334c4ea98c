"""The running mean and variance of observations."""

import numpy as np

from bench.training import normaliser

FIRST_WEIGHT = 1e-3
"""Allowed effect of the initial mean 0 and variance 1 after a hundred observations, which weigh 1e6 times as much."""


def test_parts_give_the_mean_and_variance_of_the_whole():
    drawn = np.random.default_rng(0).standard_normal((3, 100)) * [[1.0], [10.0], [0.1]] + [[5.0], [0.0], [-2.0]]
    known = normaliser.start(3, "float64")
    for part in np.split(drawn, [7, 30, 31, 90], axis=1):
        known = normaliser.updated(known, part)
    np.testing.assert_allclose(known.mean, drawn.mean(axis=1), rtol=FIRST_WEIGHT, atol=FIRST_WEIGHT)
    np.testing.assert_allclose(known.variance, drawn.var(axis=1), rtol=FIRST_WEIGHT)
    seen = np.asarray(normaliser.normalised(known, drawn))
    np.testing.assert_allclose(seen.std(axis=1), 1.0, rtol=FIRST_WEIGHT)


def test_a_constant_observation_stays_finite():
    known = normaliser.updated(normaliser.start(1, "float64"), np.full((1, 50), 3.0))
    assert np.isfinite(normaliser.normalised(known, np.array([[3.0, 4.0]]))).all()
