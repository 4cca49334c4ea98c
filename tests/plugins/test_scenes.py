"""Every scene against closed forms, published numbers, and itself on other backends."""

import dataclasses
import math

import numpy as np
import pytest
from bench.plugins.backends.jax import Jax
from bench.plugins.contacts.impulse import Impulse
from bench.plugins.contacts.penalty import Penalty
from bench.plugins.integrators.explicit_euler import ExplicitEuler
from bench.plugins.integrators.semi_implicit_euler import SemiImplicitEuler
from bench.plugins.scenes.bounce_once import BounceOnce
from bench.plugins.scenes.bouncing_ball import BouncingBall
from bench.plugins.scenes.cartpole import Cartpole
from bench.plugins.scenes.cubic import Cubic
from bench.plugins.scenes.double_integrator import DoubleIntegrator
from bench.plugins.scenes.pushing import Pushing
from bench.plugins.scenes.wall_penalty_1d import WallPenalty1d

from bench.model import MechanicalScene, compose

# -------------------------------------------------------------------------------------------- used throughout

DIFFERENCED = 1e-6
"""Relative truncation of central differences of step eps = 1e-6, with a wide margin: eps^2 times third derivatives."""
ROUNDED_OVER_EPS = 1e-8
"""What the rounding of numbers of size 1 leaves in such a difference: 1e-16 over eps, and a margin for many operations."""


def program(scene, law=None, integrator=None, **values):
    """The scene under a law that takes the scene's contact values, then ``values``."""
    if law is not None:
        fields = {f.name for f in dataclasses.fields(law)}
        given = {k: v for k, v in scene.contact_values.items() if k in fields}
        law = law(**{**given, **values})
    if isinstance(scene, MechanicalScene):
        integrator = integrator or SemiImplicitEuler()
    return compose(scene, law, integrator)


def normal(n, samples, seed=0):
    return np.random.default_rng(seed).standard_normal((n, samples))


def quiet(problem):
    return np.zeros((problem.program.n_noise, 1))


def gradient(problem, theta=None):
    """Gradient without noise."""
    theta = problem.program.theta0 if theta is None else np.asarray(theta, float)
    return problem.grad(theta, quiet(problem))[:, 0]


def variance(samples):
    """Trace of the covariance of samples ``(d, B)``."""
    return samples.var(axis=1, ddof=1).sum()


def assert_mean(samples, expected):
    """The mean of samples ``(d, B)`` is the expected one within 5 standard errors (and rounding, where those are 0)."""
    error = samples.std(axis=1, ddof=1) / math.sqrt(samples.shape[1])
    assert np.all(np.abs(samples.mean(axis=1) - expected) <= 5 * error + 1e-12 * (1 + np.abs(expected)))


# ----------------------------------------------------------------------------------------- implicit contact


# --------------------------------------------------------------------------------------------- closed forms


def test_closed_forms_are_refused_where_they_do_not_hold():
    assert BounceOnce().closed_form_gradient(Penalty(), SemiImplicitEuler()) is None
    assert BounceOnce().closed_form_gradient(Impulse(time_of_impact=False), SemiImplicitEuler()) is None
    assert DoubleIntegrator().closed_form_gradient(None, None) is None


@pytest.mark.parametrize("integrator", [SemiImplicitEuler(), ExplicitEuler()], ids=lambda i: i.name)
def test_double_integrator(integrator):
    """Its gradients and their variance, also without noise."""
    scene = DoubleIntegrator(horizon=7, dt=0.3)
    problem = Jax().compile(program(scene, integrator=integrator))
    expected = scene.closed_form_gradient(None, integrator)
    assert gradient(problem) == pytest.approx(expected, rel=1e-12)
    samples = problem.grad(scene.theta0(), normal(7, 20_000))
    assert_mean(samples, expected)
    # The gradient is c times one normal number, whose variance over B samples has a relative error of sqrt(2 / B).
    assert variance(samples) == pytest.approx(scene.first_order_variance(integrator), rel=5 * math.sqrt(2 / 20_000))


def test_cubic_smoothing_shifts_the_gradient():
    scene = Cubic(sigma=0.3)
    difference = scene.closed_form_gradient(None, None) - scene.physical_gradient()
    assert difference == pytest.approx(np.full(5, 0.09))


def test_cartpole_is_balanced():
    scene = Cartpole(horizon=500)
    problem = Jax().compile(program(scene))
    theta = scene.theta0()
    assert problem.value(theta, quiet(problem))[0] < 1.0
    assert problem.value(0 * theta, quiet(problem))[0] > 10.0


# --------------------------------------------------------------------------------------------- bounce_once


def test_bounce_once_physics_is_the_impulse_program():
    for scene in (BounceOnce(), BounceOnce(velocity=-0.2), BounceOnce(restitution=0.5)):
        assert gradient(Jax().compile(program(scene, Impulse))) == pytest.approx(scene.physical_gradient(), rel=1e-9)


# ------------------------------------------------------------------------------------------- bouncing_ball


def drop(scene, height, velocity):
    """Cost of a ball bouncing rigidly, by events."""
    time, start, speed, end = 0.0, height, velocity, scene.horizon * scene.dt
    while True:
        impact = math.sqrt(speed**2 + 2 * scene.gravity * start)
        flight = (speed + impact) / scene.gravity
        if time + flight > end:
            left = end - time
            return (start + speed * left - 0.5 * scene.gravity * left**2 - scene.target) ** 2
        time, start, speed = time + flight, 0.0, scene.restitution * impact


@pytest.mark.parametrize("restitution", [1.0, 0.7])
@pytest.mark.parametrize("horizon", [100, 400, 900])
def test_bouncing_ball_physical_gradient(restitution, horizon):
    """None, one and several bounces, against differences."""
    scene = BouncingBall(restitution=restitution, horizon=horizon, velocity=0.3)
    eps = 1e-6
    differences = [
        (drop(scene, 1 + eps, 0.3) - drop(scene, 1 - eps, 0.3)) / (2 * eps),
        (drop(scene, 1, 0.3 + eps) - drop(scene, 1, 0.3 - eps)) / (2 * eps),
    ]
    assert scene.physical_gradient() == pytest.approx(differences, rel=DIFFERENCED, abs=ROUNDED_OVER_EPS)


def test_bouncing_ball_at_rest_has_no_physical_gradient():
    assert BouncingBall(restitution=0.0).physical_gradient() is None
    assert BouncingBall(restitution=0.5, horizon=4000).physical_gradient() is None


# ----------------------------------------------------------------------------------------- wall_penalty_1d


def exact(starts):
    return np.array([WallPenalty1d(start=s).physical_gradient()[0] for s in starts])


def test_wall_exact_gradient():
    """The values published, and how the pieces meet."""
    rebound = math.exp(-0.5 * math.pi / math.sqrt(49.75))
    assert rebound == pytest.approx(0.800354, rel=1e-6)
    assert exact([0.1, 0.3, 0.31, 1.0, 1.55, 2.1]) == pytest.approx([-rebound, -rebound, *[rebound] * 3, -1.0])
    edges = WallPenalty1d().breakpoints()[0]
    assert edges == pytest.approx((0.0, 0.305149, 1.554597, 2.0, 3.0), abs=1e-6)
    below, above = exact([e - 1e-9 for e in edges[2:4]]), exact([e + 1e-9 for e in edges[2:4]])
    assert below == pytest.approx(above, abs=1e-6)  # the derivative is continuous there, to the offset
    assert WallPenalty1d(start=-0.1).physical_gradient() is None


# ------------------------------------------------------------------------------------------------- pushing


@pytest.mark.slow
def test_pushing_published_gradient_norm():
    """Norm of the mean of 1,000 gradients."""
    scene = Pushing(horizon=100, velocity_factor=0.1, push=1.0, speed=0.1)
    made = program(scene, Penalty)
    theta, w = scene.theta0(), normal(100, 1000)
    problem = Jax().compile(made)
    samples = problem.grad(theta, w)
    mean = samples.mean(axis=1)
    norm = np.linalg.norm(mean)
    error = (mean / norm @ samples).std() / math.sqrt(1000)
    assert abs(norm - 18.66) < 5 * error
    assert error < 0.05
