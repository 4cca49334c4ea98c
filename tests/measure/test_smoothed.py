"""Noise of the scene's own, and references of other smoothings, against closed forms."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from classes import Fobg, Guided, MeasureValued, Numpy, RandomizedSmoothing, Reinforce, SphereSmoothing
from helpers import loaded

from bench.experiment.session import Problems
from bench.measure.reference import certify
from bench.measure.smoothed import over_ball, widened
from bench.model import FunctionScene, compose
from bench.run.references import References

ERRORS = 4.5
"""Standard errors: below 1e-5 by chance."""
DIFFERENCES = 1e-6
"""Relative error of the numpy backend's central differences."""


@dataclass(frozen=True)
class Windy(FunctionScene):
    """f = x0^2 e0^2 + x1 e1 + 3 x1: E f has the gradient (2 theta0, 3), while f at e = 0 has (0, 3)."""

    name = "windy"
    exogenous: ClassVar[int] = 2
    continuous: ClassVar[bool] = True

    def theta0(self):
        return np.array([1.0, 2.0])

    def cost(self, xp, x, e):
        return x[0] ** 2 * e[0] ** 2 + x[1] * e[1] + 3 * x[1]


@dataclass(frozen=True)
class Quartic(FunctionScene):
    """f = |x|^4 with d = 3."""

    name = "quartic"

    def theta0(self):
        return np.array([1.0, -0.5, 0.25])

    def cost(self, xp, x):
        return xp.sum(x**2, axis=0) ** 2


def compiled(scene):
    return Numpy().compile(compose(scene))


@pytest.mark.parametrize(
    "estimator",
    [
        Fobg(),
        Reinforce(),
        MeasureValued(),
        RandomizedSmoothing(),
        RandomizedSmoothing(variant="forward"),
        Guided(share=1.0),
        SphereSmoothing(),
    ],
    ids=str,
)
def test_estimators_average_over_the_scenes_own_noise(estimator):
    problem = compiled(Windy())
    assert (problem.dim, problem.program.n_noise) == (2, 4)
    noise = np.random.default_rng(1).standard_normal((64, 256, 4))
    found = estimator.estimate(problem, problem.program.theta0, noise)
    error = found.std(axis=0, ddof=1) / 8
    assert (np.abs(found.mean(axis=0) - [2.0, 3.0]) < ERRORS * error + DIFFERENCES).all(), (found.mean(axis=0), error)


def test_the_reference_averages_over_the_scenes_own_noise():
    problem = compiled(Windy())
    known = certify(problem, Numpy.provides, 1 << 15, 0.005).known()
    assert np.linalg.norm(known.mean - [2.0, 3.0]) < ERRORS * known.standard_error
    assert known.standard_error < 0.1


def test_the_gradient_of_a_ball_average_and_of_a_wider_gaussian():
    problem, radius = compiled(Quartic(sigma=0.1)), 1.5
    theta = problem.program.theta0
    # E grad f over the ball is 4 theta (|theta|^2 + r^2), for a Gaussian 4 theta (|theta|^2 + (d + 2) s^2)
    ball = over_ball(problem, Numpy.provides, radius, 1 << 15, 0.002)
    known = ball.known()
    exact = 4 * theta * (theta @ theta + radius**2)
    assert np.linalg.norm(known.mean - exact) < ERRORS * known.standard_error + DIFFERENCES
    assert known.standard_error < 0.02 * np.linalg.norm(exact)
    wide = certify(Numpy().compile(widened(problem.program, radius)), Numpy.provides, 1 << 15, 0.01).known()
    assert np.linalg.norm(wide.mean - 4 * theta * (theta @ theta + 5 * radius**2)) < ERRORS * wide.standard_error
    # both orders of the ball agree: without gradients only the sphere is left
    known = over_ball(problem, frozenset({"value"}), radius, 1 << 15, 0.002).known()
    assert np.linalg.norm(known.mean - exact) < ERRORS * known.standard_error


def test_rows_are_measured_against_the_smoothing_that_they_ask_for(tmp_path):
    estimators = ",".join(
        f"'{name}[radius=0.2{own}]'"
        for name in ("sphere_smoothing", "randomized_smoothing")
        for own in ("", ",reference=own")
    )
    experiment, of = loaded(
        "scenes=[heaviside]",
        "scene.heaviside.theta=0.05",
        "backends=[numpy]",
        f"estimators=[{estimators}]",
        f"results_dir={tmp_path}",
    )
    found = [References(experiment, Problems()).of(cell) for cell in of]
    gauss = [np.exp(-0.5 * (0.05 / s) ** 2) / (np.sqrt(2 * np.pi) * s) for s in (0.1, 0.2)]
    np.testing.assert_allclose([one.gradient[0] for one in found], [gauss[0], 1 / 0.4, gauss[0], gauss[1]], rtol=1e-9)
    assert [one.method for one in found] == [
        "closed_form",
        "ball[radius=0.2],exact",
        "closed_form",
        "gaussian[radius=0.2],closed_form",
    ]
    assert [cell.estimator.declares_unbiased(cell.program()) for cell in of] == [False, True, False, True]
