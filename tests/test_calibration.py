"""The 95% bias interval, held against closed-form biases over independent cells."""

import numpy as np
import pytest

from bench import noise
from bench.grid import Cell
from bench.reference import certify
from bench.session import Problems
from bench.statistics import summarise
from bench.studies.bias_variance import truth_of
from plugins.backends.numpy import Numpy
from plugins.estimators.finite_difference import FiniteDifference
from plugins.estimators.fobg import Fobg
from plugins.estimators.randomized_smoothing import RandomizedSmoothing
from plugins.estimators.reinforce import Reinforce
from plugins.scenes.cubic import Cubic
from plugins.scenes.heaviside import Heaviside
from plugins.scenes.quadratic import Quadratic
from plugins.scenes.soft_heaviside import SoftHeaviside

SIGMA = 0.3
SEEDS = range(12)
DIMENSIONS = (1, 3, 10, 30, 100)


def smoothed_cubic_bias(radius: float, dim: int) -> float:
    """f = sum x^3 / 3 has grad J_s = theta^2 + s^2 in each coordinate."""
    return abs(radius**2 - SIGMA**2) * np.sqrt(dim)


UNBIASED = [
    (scene(dimension=d, sigma=SIGMA), estimator, 0.0)
    for d in DIMENSIONS
    for scene in (Quadratic, Cubic)
    for estimator in (Fobg(), Reinforce(), Reinforce(baseline="leave_one_out"), RandomizedSmoothing())
] + [(Heaviside(theta=0.05), Reinforce(), 0.0), (SoftHeaviside(), Fobg(), 0.0)]

BIASED = [
    case
    for d in DIMENSIONS
    for case in (
        (Cubic(dimension=d, sigma=SIGMA), RandomizedSmoothing(radius=0.5), smoothed_cubic_bias(0.5, d)),
        (Cubic(dimension=d, sigma=SIGMA), RandomizedSmoothing(radius=1.0), smoothed_cubic_bias(1.0, d)),
        (Cubic(dimension=d, sigma=SIGMA), FiniteDifference(step=0.2), 0.2**2 / 3 * np.sqrt(d)),
        (Cubic(dimension=d, sigma=SIGMA), FiniteDifference(step=0.6), 0.6**2 / 3 * np.sqrt(d)),
    )
]


@pytest.mark.parametrize("cases", [UNBIASED, BIASED], ids=["zero bias", "non-zero bias"])
def test_interval_covers_the_true_bias(cases, capsys):
    problems = Problems()
    inside = []
    for scene, estimator, bias in cases:
        for seed in SEEDS:
            cell = Cell(scene, None, None, Numpy(), estimator, 16, 48, seed)
            problem = problems.of(cell.backend, cell)
            truth = certify(problem, cell.backend.provides, 4096, 0.01)
            assert truth.method == "closed_form"
            w = noise.draw(seed, f"{estimator}{scene}", cell.repeats, cell.samples, problem.dim, "calibration")
            summary = summarise(estimator.estimate(problem, scene.theta0(), w), truth_of(truth), cell.samples)
            inside.append(summary.bias_low - 1e-12 <= bias <= summary.bias_high + 1e-12)
    assert len(inside) >= 200
    covered = np.mean(inside)
    with capsys.disabled():
        print(f"\n  {len(inside)} cells, coverage {covered:.3f}")
    assert 0.91 <= covered <= 0.99


def test_fobg_on_heaviside_is_certain_and_wrong():
    scene = Heaviside()
    cell = Cell(scene, None, None, Numpy(), Fobg(), 64, 16, 0)
    problem = Problems().of(cell.backend, cell)
    truth = certify(problem, cell.backend.provides, 4096, 0.01)
    estimates = Fobg().estimate(problem, scene.theta0(), noise.draw(0, "heaviside", 16, 64, 1, "calibration"))
    summary = summarise(estimates, truth_of(truth), 64)
    assert summary.variance == 0.0
    assert summary.bias == pytest.approx(3.98942, rel=1e-5)
    assert summary.bias_low == pytest.approx(summary.bias, rel=1e-9)
    assert summary.bias_high == pytest.approx(summary.bias, rel=1e-9)
    assert summary.note
