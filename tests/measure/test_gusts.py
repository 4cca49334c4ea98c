"""Noise from outside in mechanical scenes, wider than theta: references and estimators against closed forms."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from classes import Numpy, SemiImplicitEuler

from bench.conformance import check
from bench.model import Decision, ProcessNoiseScene, State, compose


@dataclass(frozen=True)
class GustyCart(ProcessNoiseScene):
    """A constant force theta (d = 1) plus a gust per step pushes a cart from rest; f = (q_N - edge)^3.

    q_N = c (theta + sigma u) + b . gust e, with b_i = dt^2 (N - i) / mass for semi-implicit and dt^2 (N - i - 1) / mass
    for explicit Euler, and c the sum of b. So q_N is normal with mean m = c theta and variance s^2 = c^2 sigma^2 + gust^2
    |b|^2, and grad J = 3 c ((m - edge)^2 + s^2), of which the gusts make more than half.
    """

    name = "gusty_cart"
    continuous: ClassVar[bool] = True
    n_q: ClassVar[int] = 1
    n_u: ClassVar[int] = 1

    sigma: float = 0.05
    gust: float = 2.0
    horizon: int = 20
    dt: float = 0.05
    mass: float = 1.0
    force: float = 1.0
    edge: float = 0.75

    def theta0(self):
        return np.array([self.force])

    def initial_state(self, xp, theta):
        return State(0.0 * theta[:1], 0.0 * theta[:1])

    def planned_controls(self, xp, theta):
        return xp.broadcast_to(theta[None, :1], (self.horizon, 1, theta.shape[1]))

    def acceleration(self, xp, q, v, u):
        return u / self.mass

    def terminal_cost(self, xp, q, v):
        return (q[0] - self.edge) ** 3

    def closed_form_gradient(self, contact, integrator):
        steps = {"semi_implicit_euler": 0, "explicit_euler": 1}
        if integrator is None or integrator.name not in steps:
            return None
        b = self.dt**2 * (self.horizon - steps[integrator.name] - np.arange(self.horizon)) / self.mass
        c = float(b.sum())
        variance = (c * self.sigma) ** 2 + self.gust**2 * b @ b
        return np.array([3.0 * c * ((c * self.force - self.edge) ** 2 + variance)])


CHECKS = {"closed_form_is_right", "noise_is_where_declared", "backends_agree", "score_gives_the_gradient"}


def test_means_over_gusts_are_the_closed_form_and_backends_have_the_same_gusts():
    results = check(GustyCart, CHECKS)
    assert {result.outcome for result in results} == {"pass"}, results
    # without gusts the gradient is another one
    windy, still = (compose(GustyCart(gust=g), None, SemiImplicitEuler()).closed_form_gradient() for g in (2.0, 0.0))
    assert abs(windy[0] - still[0]) > 0.1 * windy[0]


def test_noise_on_theta_can_be_left_out_without_the_gusts():
    problem = Numpy().compile(compose(GustyCart(horizon=5, dt=0.2), None, SemiImplicitEuler()))
    assert (problem.dim, problem.program.n_noise, problem.program.exogenous) == (1, 6, 5)
    w = np.random.default_rng(3).standard_normal((6, 256))
    assert (problem.centred(w)[:1] == 0).all()
    assert (problem.centred(w)[1:] == w[1:]).all()


def test_gusts_stay_where_theta_names_a_parameter():
    program = compose(GustyCart(horizon=5, dt=0.2), None, SemiImplicitEuler(), Decision(names=("mass",)))
    w = np.random.default_rng(4).standard_normal((6, 4))
    cost = Numpy().compile(program).value(program.theta0, w)
    assert program.n_noise == 6
    b = 0.04 * (5 - np.arange(5))
    reached = (b.sum() * 1.0 + 2.0 * b @ w[1:]) / (1.0 + 0.05 * w[0])
    assert cost == pytest.approx((reached - 0.75) ** 3, rel=1e-9)


def test_gusts_need_controls():
    with pytest.raises(TypeError, match="set n_u"):

        @dataclass(frozen=True)
        class Without(ProcessNoiseScene):
            name = "without"
