"""Zeroth-order estimators of low variance against closed forms."""

import numpy as np
import pytest
from bench.plugins.estimators.sobol import Sobol, directions, points
from bench.plugins.scenes.linear import Linear
from classes import Cubic, Numpy, OptimalBaseline, QuadraticModel
from scipy import stats

import bench
from bench.model import compose

ROUNDING = 1e-9
"""Relative rounding of a fit of 21 coefficients."""


def problem(scene):
    return Numpy().compile(compose(scene))


def drawn(repeats, samples, d, seed=0):
    return np.random.default_rng(seed).standard_normal((repeats, samples, d))


def test_each_quasi_random_direction_alone_is_normal():
    first = directions(drawn(2000, 16, 1))[:, 0, 0]
    assert stats.kstest(first, "norm").pvalue > 1e-4


@pytest.mark.parametrize(("samples", "block"), [(9, 256), (12, 256), (25, 256), (50, 256), (50, 20)])
def test_quadratic_model_is_fitted_without_the_sample_it_is_subtracted_from(samples, block):
    """Equals a fit for each sample by lstsq: of c, of g too, of the diagonal too, and of all of H."""
    scene = Cubic(dimension=3, sigma=0.7)
    p, w = problem(scene), drawn(2, samples, 3)
    expected = np.zeros((2, 3))
    for r in range(2):
        f = p.value(p.program.theta0, w[r].T)
        for part in np.array_split(np.arange(samples), -(-samples // block)):
            x, room = [np.ones(len(part))], len(part) // 2 - 2
            i, j = np.triu_indices(3, 1)
            x += [*w[r, part].T] * (room >= 3) + [*w[r, part].T ** 2] * (room >= 6)
            x += [*(w[r, part][:, i] * w[r, part][:, j]).T] * (room >= 9)
            x = np.array(x).T
            for n in range(len(part)):
                others = np.arange(len(part)) != n
                fit = np.linalg.lstsq(x[others], f[part][others], rcond=None)[0]
                g = fit[1:4] if len(fit) > 1 else 0.0
                expected[r] += ((f[part][n] - x[n] @ fit) * w[r, part[n]] + g) / (samples * scene.sigma)
    values = QuadraticModel(block=block).estimate(p, p.program.theta0, w)
    np.testing.assert_allclose(values, expected, rtol=ROUNDING)


def test_a_repeats_directions_have_one_in_each_of_n_equal_parts_of_every_coordinate():
    v = directions(drawn(50, 64, 5))
    parts = np.sort(np.floor(stats.norm.cdf(v) * 64), axis=1)
    assert (parts == np.arange(64)[:, None]).all()


def test_points_are_those_of_scipy():
    sequence = stats.qmc.Sobol(3, scramble=False).random_base2(5)
    np.testing.assert_array_equal(points(32, 3) / 2.0**52, sequence)
    np.testing.assert_array_equal(points(20, 3), points(32, 3)[:20])


def test_too_few_samples_are_an_error_that_says_how_many_are_needed():
    p = problem(Linear())
    for estimator, needed in ((OptimalBaseline(), 2), (QuadraticModel(), 4)):
        with pytest.raises(ValueError, match=f"{estimator.name} needs at least {needed} samples, got {needed - 1}"):
            estimator.estimate(p, p.program.theta0, drawn(1, needed - 1, p.dim))


def test_the_bias_of_quasi_random_directions_on_actions_is_not_denied():
    assert not Sobol().declares_unbiased(bench.problem("cartpole", backend="numpy").program)
