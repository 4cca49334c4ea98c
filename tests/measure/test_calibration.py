"""The 95% bias interval against closed-form biases, over many independent sets of estimates."""

import numpy as np
import pytest
from bench.plugins.backends.numpy import Numpy
from bench.plugins.estimators.finite_difference import FiniteDifference
from bench.plugins.estimators.fobg import Fobg
from bench.plugins.estimators.randomized_smoothing import RandomizedSmoothing
from bench.plugins.estimators.reinforce import Reinforce
from bench.plugins.scenes.cubic import Cubic
from bench.plugins.scenes.heaviside import Heaviside
from bench.plugins.scenes.quadratic import Quadratic
from bench.plugins.scenes.soft_heaviside import SoftHeaviside

from bench.measure import noise
from bench.measure.reference import certify
from bench.measure.statistics import summarise
from bench.model import compose

SIGMA = 0.3
SETS = 240
"""Sets of estimates, at least."""
SAMPLES, REPEATS = 16, 48
BUDGET, TOLERANCE = 4096, 0.01
"""Of references: not spent, since all have closed forms."""
ROUNDING = 1e-12
"""A bias of exactly zero comes out as the rounding of some thousand terms of size 1."""
EQUAL = 1e-9
"""Without variance the interval is one point, up to the rounding of its quantiles."""
DIGITS = 1e-5
"""Closed forms are written here with six digits."""


def smoothed_cubic_bias(radius: float, dim: int) -> float:
    """f = sum x^3 / 3 has grad J_s = theta^2 + s^2 in each coordinate."""
    return abs(radius**2 - SIGMA**2) * np.sqrt(dim)


def unbiased(dimensions):
    """Scenes of some dimensions, estimators without a bias on them, and 0."""
    estimators = (Fobg(), Reinforce(), Reinforce(baseline="leave_one_out"), RandomizedSmoothing())
    scenes = [scene(dimension=d, sigma=SIGMA) for d in dimensions for scene in (Quadratic, Cubic)]
    jumps = [(Heaviside(theta=0.05), Reinforce(), 0.0), (SoftHeaviside(), Fobg(), 0.0)]
    return [(scene, estimator, 0.0) for scene in scenes for estimator in estimators] + jumps


def biased(dimensions):
    """The cubic of some dimensions, estimators with a bias on it, and the bias."""
    return [
        case
        for d in dimensions
        for case in (
            (Cubic(dimension=d, sigma=SIGMA), RandomizedSmoothing(radius=0.5), smoothed_cubic_bias(0.5, d)),
            (Cubic(dimension=d, sigma=SIGMA), RandomizedSmoothing(radius=1.0), smoothed_cubic_bias(1.0, d)),
            (Cubic(dimension=d, sigma=SIGMA), FiniteDifference(step=0.2), 0.2**2 / 3 * np.sqrt(d)),
            (Cubic(dimension=d, sigma=SIGMA), FiniteDifference(step=0.6), 0.6**2 / 3 * np.sqrt(d)),
        )
    ]


@pytest.mark.parametrize("dimensions", [(1, 10), pytest.param((3, 30, 100), marks=pytest.mark.slow)])
@pytest.mark.parametrize("cases_of", [unbiased, biased])
def test_interval_covers_the_true_bias(cases_of, dimensions):
    cases = cases_of(dimensions)
    inside = []
    for scene, estimator, bias in cases:
        problem = Numpy().compile(compose(scene))
        truth = certify(problem, Numpy.provides, BUDGET, TOLERANCE)
        assert truth.method == "closed_form"
        for seed in range(-(-SETS // len(cases))):
            w = noise.draw(seed, f"{estimator}{scene}", REPEATS, SAMPLES, problem.dim, "calibration")
            summary = summarise(estimator.estimate(problem, problem.program.theta0, w), truth.known(), SAMPLES)
            inside.append(summary.bias_low - ROUNDING <= bias <= summary.bias_high + ROUNDING)
    covered = np.mean(inside)
    # with 240 sets and more, 0.95 +- 2.6 standard errors of a proportion
    assert 0.91 <= covered <= 0.99


def test_fobg_on_heaviside_is_certain_and_wrong():
    problem = Numpy().compile(compose(Heaviside()))
    truth = certify(problem, Numpy.provides, BUDGET, TOLERANCE)
    w = noise.draw(0, "heaviside", 16, 64, 1, "calibration")
    summary = summarise(Fobg().estimate(problem, problem.program.theta0, w), truth.known(), 64)
    assert summary.variance == 0.0
    assert summary.bias == pytest.approx(3.98942, rel=DIGITS)
    rare = 3 / (16 * 64)  # the rule of three
    assert summary.bias_low == pytest.approx(summary.bias * (1 - rare), rel=EQUAL)
    assert summary.bias_high == pytest.approx(summary.bias * (1 + rare), rel=EQUAL)
    assert summary.note
