"""Scenes of several contact modes against published numbers, exact motions and the central path."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from classes import (
    BounceOnce,
    BouncingBall,
    Complementarity,
    DoubleIntegrator,
    GroundWall,
    Implicit,
    Impulse,
    Jax,
    Penalty,
    Pushing,
    SemiImplicitEuler,
    Softplus,
    Torch,
)

from bench.model import ContactScene, State, compose, param

# ------------------------------------------------------------------------------------------------ closed forms


def test_closed_forms_are_refused_where_they_do_not_hold():
    assert BounceOnce().closed_form_gradient(Penalty(), SemiImplicitEuler()) is None
    assert BounceOnce().closed_form_gradient(Impulse(time_of_impact=False), SemiImplicitEuler()) is None
    assert DoubleIntegrator().closed_form_gradient(None, None) is None


@pytest.mark.parametrize(
    "scene",
    [
        GroundWall(restitution=0.0),
        GroundWall(restitution=0.1, horizon=2000),
        BouncingBall(restitution=0.0),
        BouncingBall(restitution=0.5, horizon=4000),
    ],
    ids=repr,
)
def test_a_ball_at_rest_has_no_physical_gradient(scene):
    assert scene.physical_gradient() is None
    assert scene.physical_cost() is None


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


def test_a_softplus_contact_pushes_at_touch():
    """By ln 2 / beta times the stiffness, where a penalty has no force."""
    still = np.zeros((1, 1))
    assert Softplus(stiffness=3.0, beta=10.0).force(np, still, still) == pytest.approx(3.0 * np.log(2.0) / 10.0)


# ------------------------------------------------------------------------------------------------ central path


@dataclass(frozen=True)
class OneStep(ContactScene):
    """A mass of 1 kg that would be at height theta after one step, over ground; f = its height after it."""

    name = "one_step"
    n_q: ClassVar[int] = 1
    n_contacts: ClassVar[int] = 1
    horizon: int = param(1)
    dt: float = param(1.0)

    def theta0(self):
        return np.array([0.5])

    def initial_state(self, xp, theta):
        return State(theta, 0.0 * theta)

    def acceleration(self, xp, q, v, u):
        return 0.0 * v

    def gap(self, xp, q):
        return q

    def gap_rate(self, xp, q, v):
        return v

    def contact_acceleration(self, xp, q, force):
        return force

    def terminal_cost(self, xp, q, v):
        return q[0]


A = np.array([-3.0, -1.0, -0.3, -1e-3, 0.0, 1e-3, 0.3, 1.0, 3.0])


@pytest.mark.parametrize("kappa", [1.0, 1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("step", [1.0, 0.5], ids=["rigid", "soft"])
def test_central_path(kappa, step):
    """y = (a + sqrt(a^2 + 4 kappa)) / 2 and dy/da, where a newton opens the gap by dt^2 and the rest to 1 m is softness."""
    softness = 1.0 - step**2
    law = Complementarity(kappa=kappa, stiffness=1.0 / softness if softness else math.inf)
    problem = Implicit().compile(compose(OneStep(dt=step), law, SemiImplicitEuler()))
    w = np.zeros((1, len(A)))
    height, slope = problem.value(A[None], w), problem.grad(A[None], w)[0]
    remaining, remaining_slope = (softness * part / step**2 for part in (height - A, slope - 1.0))
    root = np.sqrt(A**2 + 4 * kappa)
    assert height + remaining == pytest.approx(
        (A + root) / 2, abs=1e-9
    )  # solved to 1e-12, through a condition of 1/kappa
    assert slope + remaining_slope == pytest.approx((1 + A / root) / 2, abs=1e-9)


@pytest.mark.parametrize("backend", [Jax(), Torch()])
@pytest.mark.parametrize("steps", [3, 4, 6])
def test_impact_at_the_very_start_of_a_step_has_the_gradient_of_the_physics(backend, steps):
    """All numbers are binary fractions, so that the gap is exactly 0 at a step; its time of impact moves all the same."""
    scene = BounceOnce(horizon=8, dt=1 / 512, radius=0.125, height=0.125 + steps * 2.0 / 512)
    problem = backend.compile(compose(scene, Impulse(), SemiImplicitEuler()))
    gradient = problem.grad(scene.theta0(), np.zeros((3, 1)))[:, 0]
    # a central difference over a kink of the program itself would see both sides; the last component is of order dt^2
    assert gradient[:2] == pytest.approx(scene.physical_gradient()[:2], abs=1e-6)
