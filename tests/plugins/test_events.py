"""Estimators that use declared events, against closed forms and exact sums over all outcomes."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from classes import (
    Boundary,
    Cubic,
    Fobg,
    Heaviside,
    Ledge,
    StochasticDerivative,
    Torch,
)
from scipy import stats

from bench.model import Events, EventScene, FunctionScene, compose, half_spaces
from bench.model.events import events_of

LIMIT = 4.5
"""Standard errors within which a mean agrees with its expectation."""


def problem(scene):
    return Torch().compile(compose(scene))  # exact derivatives: differences see a jump within a step of it


def estimates(estimator, scene, repeats=1000, samples=64, seed=0):
    p = problem(scene)
    w = np.random.default_rng(seed).standard_normal((repeats, samples, p.program.n_noise))
    return estimator.estimate(p, p.program.theta0, w)


def agrees(values, truth):
    error = values.std(axis=0) / np.sqrt(len(values))
    return (np.abs(values.mean(axis=0) - truth) <= LIMIT * error + 1e-9).all()


def test_events_of_a_problem_with_twice_the_noise_are_at_half_the_limits():
    scene, w = Heaviside(sigma=0.3), np.linspace(-2.0, 2.0, 9)[None]
    doubled = SimpleNamespace(program=compose(scene), sigma=0.6, dim=1)
    theta = doubled.program.theta0 + 0.1
    whole, found = scene.events(theta, 2 * w), events_of(doubled, theta, w)
    assert np.array_equal(found.directions @ w < found.limits, whole.directions @ (2 * w) < whole.limits)
    assert found.slopes == pytest.approx(whole.slopes / 2)


@dataclasses.dataclass(frozen=True)
class Coin(EventScene, FunctionScene):
    """f = a where e < x^3, else b: one coin of probability p = Phi(x^3), so that E f has the slope p' (a - b)."""

    name = "coin"
    continuous = False
    discrete = True
    exogenous = 1

    at: float = 0.8
    sign: float = 1.0
    sigma: float = 1e-9

    def theta0(self):
        return np.array([self.at])

    def cost(self, xp, x, e):
        return xp.where(e[0] < self.sign * x[0] ** 3, 0.0 * x[0] + 5.0, 0.0 * x[0] + 2.0)

    def events(self, theta, w):
        x = theta[0] + self.sigma * w[:1]
        return Events(np.array([[0.0, 1.0]]), self.sign * x**3, self.sign * 3 * x[None] ** 2)


@dataclasses.dataclass(frozen=True)
class Corner(EventScene, FunctionScene):
    """f = 1 + x_0 x_1 in the quarter x_0 >= 0, x_1 >= 0.1: two boundaries that meet, each only beyond the other."""

    name = "corner"
    continuous = False

    sigma: float = 0.3

    def theta0(self):
        return np.array([0.1, 0.2])

    def cost(self, xp, x):
        return xp.where((x[0] >= 0) & (x[1] >= 0.1), 1.0 + x[0] * x[1], 0.0 * x[0])

    def events(self, theta, w):
        return half_spaces(2.0 * np.eye(2), np.array([0.0, 0.2]), self.sigma, theta, w)

    def gradient(self):
        """E f = E[1; x_0] E[1; x_1] + E[x_0; x_0 in] E[x_1; x_1 in] factors into partial means."""
        z = (self.theta0() - [0.0, 0.1]) / self.sigma
        p, density, theta = stats.norm.cdf(z), stats.norm.pdf(z), self.theta0()
        mean = theta * p + self.sigma * density
        dp, dmean = density / self.sigma, p + theta * density / self.sigma - z * density
        return dp * p[::-1] + dmean * mean[::-1]


# ------------------------------------------------------------------------------------------------ boundary terms


@pytest.mark.parametrize("theta", [-0.13, 0.0, 0.05])
@pytest.mark.parametrize("sigma", [0.1, 0.7])
def test_boundary_has_no_error_at_a_unit_step(theta, sigma):
    scene = Heaviside(theta=theta, sigma=sigma)
    values = estimates(Boundary(), scene, repeats=3, samples=5)
    np.testing.assert_allclose(values[:, 0], stats.norm.pdf(theta / sigma) / sigma, rtol=1e-12)


@pytest.mark.parametrize("scene", [Ledge(), Ledge(sigma=0.4, height=-2.0, edge=-0.1)], ids=str)
def test_boundary_is_unbiased_on_an_oblique_ledge_where_first_order_lacks_its_last_term(scene):
    truth = scene.closed_form_gradient(None, None)
    assert agrees(estimates(Boundary(), scene), truth)
    first = estimates(Fobg(), scene)
    z = (np.array([0.6, 0.8]) @ scene.theta0() - scene.edge) / scene.sigma
    assert agrees(first, [0.5, -1.0] + np.array([2.0, 1.0]) * stats.norm.cdf(z))
    assert not agrees(first, truth)


def test_boundaries_that_end_at_each_other_are_right():
    assert agrees(estimates(Boundary(), Corner()), Corner().gradient())


def test_boundary_equals_first_order_without_a_jump():
    np.testing.assert_array_equal(*(estimates(e, Cubic(), repeats=3) for e in (Boundary(), Fobg())))


# --------------------------------------------------------------------------------------- stochastic derivative


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("at", [0.3, 0.8, -0.8])
def test_one_coin_has_the_weights_of_its_source(sign, at):
    """p' / (1 - p) for a coin that fell the other way, if p grows: the mean p' jump, the variance p'^2 jump^2 p / (1 - p)."""
    scene = Coin(at=at, sign=sign)
    p, slope = stats.norm.cdf(sign * at**3), stats.norm.pdf(at**3) * 3 * at**2
    terms = StochasticDerivative().terms(problem(scene), scene.theta0(), np.array([[0.0, 0.0], [-9.0, 9.0]]))
    happened, not_happened = (0.0, slope * 3 / (1 - p)) if sign > 0 else (-slope * 3 / p, 0.0)
    np.testing.assert_allclose(terms[0], [happened, not_happened], rtol=1e-7)
    boundary = Boundary().terms(problem(scene), scene.theta0(), np.zeros((2, 1)))
    np.testing.assert_allclose(boundary[0], sign * slope * 3, rtol=1e-7)
