"""Zeroth-order estimators of low variance against closed forms."""

import numpy as np
import pytest
from bench.plugins.scenes.linear import Linear
from classes import Cubic, Numpy, OptimalBaseline, QuadraticModel

from bench.errors import Unsupported
from bench.model import compose

ROUNDING = 1e-9
"""Relative rounding of a fit of 21 coefficients."""


def problem(scene):
    return Numpy().compile(compose(scene))


def drawn(repeats, samples, d, seed=0):
    return np.random.default_rng(seed).standard_normal((repeats, samples, d))


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


def test_too_few_samples_are_refused_and_the_reason_says_how_many_are_needed():
    p = problem(Linear())
    for estimator, needed in ((OptimalBaseline(), 2), (QuadraticModel(), 4)):
        with pytest.raises(Unsupported, match=f"{estimator.name} needs at least {needed} samples, got {needed - 1}"):
            estimator.design(p.program, needed - 1)
