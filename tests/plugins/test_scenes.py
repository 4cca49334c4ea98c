"""Every scene against closed forms, published numbers, and itself on other backends."""

import math

import numpy as np
import pytest
from classes import (
    BounceOnce,
    BouncingBall,
    DoubleIntegrator,
    Impulse,
    Jax,
    Penalty,
    Pushing,
    SemiImplicitEuler,
)

from bench.model import compose


def test_closed_forms_are_refused_where_they_do_not_hold():
    assert BounceOnce().closed_form_gradient(Penalty(), SemiImplicitEuler()) is None
    assert BounceOnce().closed_form_gradient(Impulse(time_of_impact=False), SemiImplicitEuler()) is None
    assert DoubleIntegrator().closed_form_gradient(None, None) is None


def test_bouncing_ball_at_rest_has_no_physical_gradient():
    assert BouncingBall(restitution=0.0).physical_gradient() is None
    assert BouncingBall(restitution=0.5, horizon=4000).physical_gradient() is None


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
