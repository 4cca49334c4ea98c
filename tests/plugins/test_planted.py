"""The estimator that plants errors: each has the kind and size that it states."""

import math

import numpy as np
import pytest
from bench.plugins.estimators.planted import Planted
from classes import Quadratic
from dose_response.measure import compare
from scipy.stats import f, kstest

import bench

ROUNDING = 1e-12
"""Relative rounding of sums of 20 numbers."""
UNLIKELY = 1e-4
"""Probability below which a distribution counts as another one."""
D = 20


def problem(scene=None):
    return bench.problem(scene or Quadratic(dimension=D, condition=5.0), backend="numpy")


def drawn(repeats=400, samples=4, width=D, seed=0):
    return np.random.default_rng(seed).standard_normal((repeats, samples, width))


def measured(estimator, theta=None, **sizes):
    p = problem()
    theta = p.program.theta0 + 1.0 if theta is None else theta
    exact = p.grad(theta, np.zeros((D, 1)))[:, 0]
    return compare(estimator.estimate(p, theta, drawn(**sizes)), exact, 0.0)


@pytest.mark.parametrize("bias", [0.1, 0.9])
def test_planted_bias_has_its_size_and_no_spread(bias):
    found = measured(Planted(base="best", bias=bias))
    assert found["bias"] == pytest.approx(bias, rel=1e-7)
    assert found["spread"] == pytest.approx(0.0, abs=1e-7)  # the numpy backend's gradients are differences


@pytest.mark.parametrize("angle", [30.0, 90.0, 120.0])
def test_planted_rotation_has_its_angle_and_keeps_the_length(angle):
    """The error of a rotation alone is 2 sin(angle / 2)."""
    found = measured(Planted(base="best", angle=angle))
    assert found["error"] == pytest.approx(2 * math.sin(math.radians(angle / 2)), rel=1e-7)
    assert found["cosine"] == pytest.approx(math.cos(math.radians(angle)), abs=1e-7)


@pytest.mark.parametrize("noise", [0.3, 3.0])
def test_planted_noise_has_its_size_and_no_bias(noise):
    repeats = 4000
    found = measured(Planted(base="best", noise=noise), repeats=repeats)
    # the mean square of a chi-square with D repeats degrees of freedom has the relative deviation sqrt(2 / (D repeats))
    assert found["spread"] == pytest.approx(noise, rel=4 * math.sqrt(2 / (D * repeats)))
    assert found["bias"] < 4 * noise / math.sqrt(repeats)


def test_heavy_tailed_errors_follow_an_f_distribution_whose_mean_is_the_stated_square():
    p, tails, noise = problem(), 3, 0.7
    theta = p.program.theta0 + 1.0
    exact = p.grad(theta, np.zeros((D, 1)))[:, 0]
    errors = Planted(base="best", noise=noise, tails=tails).estimate(p, theta, drawn(repeats=5000)) - exact
    squares = (errors**2).sum(axis=1) / (noise**2 * exact @ exact)
    # |t|^2 / d of a multivariate t vector is F(d, tails), with mean tails / (tails - 2)
    assert kstest(squares * tails / (tails - 2), f(D, tails).cdf).pvalue > UNLIKELY
    assert kstest(squares, f(D, 300).cdf).pvalue < UNLIKELY  # a normal error is told apart
