"""Every scene against closed forms, published numbers, and itself on other backends."""

import math

import numpy as np
import pytest
from classes import (
    BounceOnce,
    BouncingBall,
    Cartpole,
    Cubic,
    DoubleIntegrator,
    Impulse,
    Jax,
    Penalty,
    Pushing,
    SemiImplicitEuler,
    WallPenalty1d,
)

from bench.model import compose


def test_closed_forms_are_refused_where_they_do_not_hold():
    assert BounceOnce().closed_form_gradient(Penalty(), SemiImplicitEuler()) is None
    assert BounceOnce().closed_form_gradient(Impulse(time_of_impact=False), SemiImplicitEuler()) is None
    assert DoubleIntegrator().closed_form_gradient(None, None) is None


def test_cubic_smoothing_shifts_the_gradient():
    scene = Cubic(sigma=0.3)
    difference = scene.closed_form_gradient(None, None) - scene.physical_gradient()
    assert difference == pytest.approx(np.full(5, 0.09))


def test_cartpole_is_balanced():
    scene = Cartpole(horizon=500)
    problem = Jax().compile(compose(scene, None, SemiImplicitEuler()))
    theta, still = scene.theta0(), np.zeros((problem.program.n_noise, 1))
    assert problem.value(theta, still)[0] < 1.0
    assert problem.value(0 * theta, still)[0] > 10.0


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
    problem = Jax().compile(compose(scene, Penalty(**scene.contact_values), SemiImplicitEuler()))
    samples = problem.grad(scene.theta0(), np.random.default_rng(0).standard_normal((100, 1000)))
    mean = samples.mean(axis=1)
    norm = np.linalg.norm(mean)
    error = (mean / norm @ samples).std() / math.sqrt(1000)
    assert abs(norm - 18.66) < 5 * error
    assert error < 0.05
