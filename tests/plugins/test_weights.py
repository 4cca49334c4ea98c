"""Estimators that weight two means, against the same weights written by hand."""

import numpy as np
import pytest
from bench.plugins.backends.numpy import Numpy
from bench.plugins.estimators.alpha_order import AlphaOrder
from bench.plugins.estimators.inverse_variance import InverseVariance
from bench.plugins.estimators.reinforce import Reinforce
from bench.plugins.scenes.cubic import Cubic

from bench.model import compose

EXACT = 1e-12
"""The same few operations in another order."""
REPEATS, SAMPLES = 3, 11


@pytest.fixture(scope="module")
def halves():
    """Problem, noise, and by repeat the gradients of the first 5 samples and the zeroth-order terms of the other 6."""
    problem = Numpy().compile(compose(Cubic(dimension=2, sigma=0.4)))
    theta = problem.program.theta0
    noise = np.random.default_rng(0).standard_normal((REPEATS, SAMPLES, 2))
    centre = problem.value(theta, np.zeros((2, 1)))
    first = [problem.grad(theta, w[:5].T) for w in noise]
    zeroth = [(problem.value(theta, w[5:].T) - centre) * w[5:].T / 0.4 for w in noise]
    return problem, theta, noise, first, zeroth


def test_inverse_variance_by_hand(halves):
    problem, theta, noise, first, zeroth = halves
    found = InverseVariance().estimate(problem, theta, noise)
    for r in range(REPEATS):
        for i in range(2):
            one, other = first[r][i], zeroth[r][i]
            a, b = np.var(one, ddof=1) / 5, np.var(other, ddof=1) / 6
            assert found[r, i] == pytest.approx((one.mean() / a + other.mean() / b) / (1 / a + 1 / b), rel=EXACT)


def test_alpha_order_by_hand(halves):
    """With a generous gamma the weight is that of the variances of both means, over all coordinates."""
    problem, theta, noise, first, zeroth = halves
    found = AlphaOrder(gamma=1e9).estimate(problem, theta, noise)
    for r in range(REPEATS):
        v1 = sum(np.var(first[r][i], ddof=1) / 5 for i in range(2))
        v0 = sum(np.var(zeroth[r][i], ddof=1) / 6 for i in range(2))
        alpha = v0 / (v1 + v0)
        assert found[r] == pytest.approx(
            alpha * first[r].mean(axis=1) + (1 - alpha) * zeroth[r].mean(axis=1), rel=EXACT
        )


@pytest.mark.parametrize("baseline", ["none", "center", "leave_one_out"])
def test_reinforce_by_hand(halves, baseline):
    problem, theta, noise, *_ = halves
    found = Reinforce(baseline=baseline).estimate(problem, theta, noise)
    for r in range(REPEATS):
        costs = problem.value(theta, noise[r].T)
        total = 0.0
        for n in range(SAMPLES):
            others = np.delete(costs, n).mean()
            b = {"none": 0.0, "center": float(problem.value(theta, np.zeros((2, 1)))[0]), "leave_one_out": others}[
                baseline
            ]
            total = total + (costs[n] - b) * noise[r, n] / 0.4
        assert found[r] == pytest.approx(total / SAMPLES, rel=1e-11)  # sums of terms 10 times the result
