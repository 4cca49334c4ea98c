"""A held control: one number of theta and of the noise for several steps."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

import bench
from bench import UserError
from bench.model import (
    LoopOps,
    MechanicalScene,
    State,
    ZeroOrderHoldScene,
    adjoint_gradient,
    param,
    slopes,
)

ROUNDING = 1e-12
"""Relative difference of the same sums in another order."""
DIFFERENCES = 1e-6
"""Relative error of central differences of a smooth cost."""


@dataclass(frozen=True)
class Cart(ZeroOrderHoldScene):
    """q'' = u from rest, with a cost of every step."""

    name = "held_cart"
    open_loop: ClassVar[bool] = True
    n_q: ClassVar[int] = 1
    n_u: ClassVar[int] = 2
    noise: str = param("action", "what the noise perturbs", choices=("action",))
    horizon: int = param(6, "steps", positive=True)

    def theta0(self):
        return np.linspace(0.5, 1.5, self.controls * self.n_u)

    def initial_state(self, xp, theta):
        return State(0.0 * theta[:1], 0.0 * theta[:1])

    def acceleration(self, xp, q, v, u):
        return u[:1] - 0.5 * u[1:] ** 2

    def stage_cost(self, xp, q, v, u):
        return ((q[0] - 1) ** 2 + u[0] ** 2) / self.hold

    def terminal_cost(self, xp, q, v):
        return (q[0] - 1) ** 2 + v[0] ** 2


def compiled(scene):
    return bench.problem(scene, backend="numpy")


@pytest.fixture(scope="module")
def noise():
    return np.random.default_rng(0).standard_normal((4, 5))


def test_a_held_control_is_the_same_control_at_each_of_its_steps(noise):
    held, free = compiled(Cart(hold=3)), compiled(Cart(hold=1))
    assert (held.dim, held.program.n_noise, free.dim) == (4, 4, 12)
    theta = held.program.theta0
    path, other = held.trajectory(theta, noise), free.trajectory(spread(theta), spread(noise))
    for found, same in zip(path, other, strict=True):
        np.testing.assert_array_equal(found, same)
    assert held.noise_on_theta
    np.testing.assert_allclose(held.score(theta, noise), noise / 0.1)


def spread(values):
    """Theta or noise of two held controls of two numbers, for each of six steps."""
    return np.repeat(values.reshape(2, 2, *values.shape[1:]), 3, axis=0).reshape(12, *values.shape[1:])


def test_refining_the_step_of_a_held_control_keeps_the_objective():
    def cost(parts):
        problem = compiled(Cart(horizon=4 * parts, hold=parts, dt=0.1 / parts))
        return problem.value(problem.program.theta0, np.zeros((8, 1)))[0]

    limit, near, far = cost(1000), cost(100), cost(10)
    # first order in the step: the distances to the cost of a step of 0 are as 1/1000, 1/100 and 1/10, up to the second
    assert near - limit == pytest.approx((far - limit) * 9 / 99, rel=0.05)


def test_the_adjoint_and_the_score_count_a_held_control_once(noise):
    problem = compiled(Cart(hold=3))
    theta = problem.program.theta0
    gradient = problem.grad(theta, noise)
    np.testing.assert_allclose(adjoint_gradient(problem, slopes(problem, theta, noise)), gradient, rtol=DIFFERENCES)
    scored = np.random.default_rng(1).standard_normal((4, 5))
    said = problem.program.log_probability(LoopOps(), theta[:, None] + 0 * noise, scored, noise)
    np.testing.assert_allclose(said, (noise * scored).sum(axis=0) / 0.1, rtol=ROUNDING)


def test_a_hold_that_does_not_fill_the_horizon_is_refused():
    with pytest.raises(UserError, match="hold=4 does not divide the horizon of 6"):
        Cart(hold=4).theta0()


def test_a_feedback_law_cannot_be_held():
    with pytest.raises(TypeError, match="set open_loop"):

        class Closed(ZeroOrderHoldScene):
            n_q = 1


@dataclass(frozen=True)
class Steady(MechanicalScene):
    """A cart with one control for all steps."""

    name = "steady_cart"
    n_q: ClassVar[int] = 1
    n_u: ClassVar[int] = 2
    noise: str = param("action", "what the noise perturbs", choices=("action",))
    horizon: int = param(6, "steps", positive=True)
    hold = 1
    initial_state, acceleration = Cart.initial_state, Cart.acceleration
    stage_cost, terminal_cost = Cart.stage_cost, Cart.terminal_cost

    def theta0(self):
        return np.array([0.5, 1.5])

    def planned_controls(self, xp, theta):
        return theta[None]


def test_the_controls_of_one_step_stand_for_all():
    w = np.random.default_rng(0).standard_normal((12, 5))
    steady, each = compiled(Steady()), compiled(Cart())
    theta = Steady().theta0()
    np.testing.assert_array_equal(steady.value(theta, w), each.value(np.tile(theta, 6), w))
    score = each.score(np.tile(theta, 6), w).reshape(6, 2, 5).sum(axis=0)
    np.testing.assert_allclose(steady.score(theta, w), score, rtol=1e-6)
