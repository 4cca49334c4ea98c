"""Estimates from noise in parts: the same numbers, in memory that does not grow with samples and repeats."""

import dataclasses

import numpy as np
import pytest
from bench.plugins.studies.bias_variance.measure import CellEstimates
from helpers import loaded

from bench.measure import noise, statistics
from bench.model import compose, registry

ROUNDED = 1e-12
"""Relative difference allowed between sums in one go and in parts."""


def cell_of(estimator, samples=48, repeats=4):
    counts = f"samples={samples}", f"repeats={repeats}"
    _, (cell,) = loaded("scenes=[cubic]", "backends=[numpy]", f"estimators=[{estimator}]", *counts)
    return cell


def made(cell):
    program = compose(cell.scene)
    problem = cell.backend.compile(program)
    estimates = CellEstimates(cell, problem, program.theta0)
    return estimates, estimates.of(0, cell.repeats)


@pytest.mark.parametrize(
    "estimator",
    ["fobg", "reinforce", "reinforce[baseline=center]", "randomized_smoothing", "inverse_variance", "plain"],
)
def test_estimates_in_parts_are_those_in_one_go(estimator, monkeypatch):
    cell = cell_of(estimator)
    whole, expected = made(cell)
    monkeypatch.setattr(noise, "HELD", 60)
    parts, found = made(cell)
    np.testing.assert_allclose(found, expected, rtol=ROUNDED, atol=ROUNDED * np.abs(expected).max())
    assert (whole.sums is None) == (parts.sums is None)
    if whole.sums is not None:
        # each less its own centre, so the statistic is compared
        values = [statistics.variance_per_sample(*one.sums, cell.samples) for one in (whole, parts)]
        np.testing.assert_allclose(values[0], values[1], rtol=1e-9)


@pytest.mark.parametrize(("most", "largest"), [(20, 20), (500, 480)])
def test_terms_of_a_long_theta_are_computed_in_parts(most, largest, monkeypatch):
    cell, sizes = cell_of("fobg"), []
    _, expected = made(cell)
    terms = type(cell.estimator).terms

    def counted(self, problem, theta, w):
        sizes.append(w.shape[1] * problem.dim)
        return terms(self, problem, theta, w)

    monkeypatch.setattr(type(cell.estimator), "terms", counted)
    monkeypatch.setattr("bench.plugins.studies.bias_variance.measure.MOST_TERMS", most)
    _, found = made(cell)
    np.testing.assert_allclose(found, expected, rtol=ROUNDED)
    assert max(sizes) == largest


def test_an_estimator_with_an_estimate_of_its_own_is_not_taken_apart():
    """A mean of terms that is clipped afterwards must not be replaced by the mean of its terms."""
    fobg = registry.make("estimators", "fobg")

    @dataclasses.dataclass(frozen=True)
    class Doubled(type(fobg)):
        def estimate(self, problem, theta, given):
            return 2.0 * super().estimate(problem, theta, given)

    cell = cell_of("fobg")
    _, expected = made(cell)
    _, found = made(cell.with_part("estimator", Doubled()))
    np.testing.assert_allclose(found, 2.0 * expected, rtol=ROUNDED)


def test_a_gradient_by_differences_counts_once():
    """The rollouts inside a gradient are its cost, not further rollouts."""
    program = compose(registry.make("scenes", "cubic"))
    problem = registry.make("backends", "numpy").compile(program)
    problem.grad(program.theta0, np.zeros((program.n_noise, 7)))
    assert (problem.usage.rollouts, problem.usage.gradients) == (0, 7)
