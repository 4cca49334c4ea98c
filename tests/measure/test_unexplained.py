"""A bias found where none is declared is said to be unexplained, and what relative columns and variances per sample mean."""

import math

import numpy as np
import pytest
from classes import (
    Cartpole,
    FiniteDifference,
    Fobg,
    Heaviside,
    Numpy,
    Quadratic,
    RandomizedSmoothing,
    Reinforce,
    SemiImplicitEuler,
)

from bench.measure.statistics import Truth, is_unexplained, summarise, variance_per_sample
from bench.model import compose


def rare_tails(repeats=64, samples=100):
    """Estimates without bias whose tails did not occur: one term in 1e5 is 1e5, the others are 0 on average."""
    return np.random.default_rng(0).standard_normal((repeats, 1)) / math.sqrt(samples)


def test_bias_of_an_unbiased_estimator_is_said_to_be_unexplained():
    truth = Truth.exact(np.ones(1))
    assert is_unexplained(summarise(rare_tails(), truth, 100, unbiased=True).note)
    assert not is_unexplained(summarise(rare_tails(), truth, 100, unbiased=False).note)
    assert not is_unexplained(summarise(rare_tails() + 1.0, truth, 100, unbiased=True).note)


@pytest.mark.parametrize(
    ("estimator", "program", "declared"),
    [
        (Fobg(), compose(Quadratic()), True),
        (Fobg(), compose(Heaviside()), False),
        (Reinforce(), compose(Heaviside()), True),
        (FiniteDifference(), compose(Quadratic()), False),
        (RandomizedSmoothing(), compose(Quadratic()), True),
        (RandomizedSmoothing(radius=0.5), compose(Quadratic(sigma=0.1)), False),
        (RandomizedSmoothing(), compose(Cartpole(), None, SemiImplicitEuler()), False),
        (Reinforce(), compose(Cartpole(), None, SemiImplicitEuler()), True),
    ],
)
def test_declarations(estimator, program, declared):
    assert estimator.declares_unbiased(program) == declared


def test_measure_says_so(monkeypatch):
    """Through the Python face: an estimator that declares to be unbiased and is not."""
    import bench

    class Off(Fobg):
        def terms(self, problem, theta, w):
            return 1.5 * problem.grad(theta, w)

    monkeypatch.setattr("bench.api.make", lambda kind, identity: Off())
    problem = Numpy().compile(compose(Quadratic()))
    assert is_unexplained(bench.estimate(problem, "fobg", samples=16, repeats=16).summary.note)


# ------------------------------------------------------------------------------------------ references near zero


def test_relative_columns_mean_nothing_where_the_reference_vanishes():
    rng = np.random.default_rng(2)
    estimates = rng.standard_normal((16, 2))
    vanishing = summarise(estimates, Truth.from_batches(rng.standard_normal((64, 2))), 4)
    assert math.isnan(vanishing.bias_rel)
    assert math.isnan(vanishing.rmse_rel)
    assert "not distinguishable from 0" in vanishing.note
    truth = Truth.from_batches(np.array([5.0, 0.0]) + 8 * rng.standard_normal((64, 2)))
    vague = summarise(estimates, truth, 4)
    assert vague.rmse_rel > 0.0
    assert summarise(1e20 * estimates, truth, 4).rmse_rel > 1e18
    assert "% of its norm" in vague.note
    assert summarise(estimates, Truth.exact(np.array([5.0, 0.0])), 4).note == ""
    assert math.isnan(summarise(estimates, Truth.exact(np.array([1e-15, 0.0]), 1e-14), 4).rmse_rel)


def test_error_that_sampling_does_not_show_widens_the_interval():
    rng = np.random.default_rng(3)
    estimates, batches = rng.standard_normal((64, 3)) * 1e-3 + 1.0, rng.standard_normal((64, 3)) * 1e-3 + 1.0
    narrow = summarise(estimates + 0.05, Truth.from_batches(batches), 4)
    wide = summarise(estimates + 0.05, Truth.from_batches(batches, unseen=0.1), 4)
    assert narrow.bias_low > 0.0
    assert wide.bias_low == 0.0
    assert wide.reference_se == pytest.approx(0.1, rel=1e-3)
    assert wide.bias_high > 0.1


# --------------------------------------------------------------------------------------- variance of one sample


def moments(terms):
    """Sums and sums of squares per repeat of ``terms (R, N, d)``."""
    return terms.sum(axis=1), (terms**2).sum(axis=(1, 2))


@pytest.mark.parametrize("repeats", [5, 8])
def test_variance_per_sample_is_that_of_all_samples(repeats):
    terms = np.random.default_rng(4).standard_normal((repeats, 50, 3)) * np.array([1.0, 2.0, 0.1]) + 7.0
    value, low, high = variance_per_sample(*moments(terms), 50)
    assert value == pytest.approx(np.trace(np.cov(terms.reshape(-1, 3).T)), rel=1e-10)
    assert low < value < high
    summary = summarise(terms.mean(axis=1), Truth.exact(np.full(3, 7.0)), 50, moments(terms))
    assert (summary.variance_per_sample, summary.variance_per_sample_low) == (value, low)
    # from all samples it is known to a fraction of what the estimates' own spread says
    coarse = summarise(terms.mean(axis=1), Truth.exact(np.full(3, 7.0)), 50)
    assert high / low < 0.5 * coarse.variance_per_sample_high / coarse.variance_per_sample_low


def test_variance_per_sample_of_few_or_equal_terms():
    assert variance_per_sample(np.ones((2, 1)), np.ones(2), 1)[1:] == (0.0, math.inf)
    assert variance_per_sample(np.full((4, 1), 1e200), np.full(4, math.inf), 3) == (math.inf, 0.0, math.inf)
    assert variance_per_sample(np.ones((4, 1)), np.ones(4), 1) == (0.0, 0.0, math.inf)
    assert math.isnan(variance_per_sample(np.ones((1, 1)), np.ones(1), 1)[0])
