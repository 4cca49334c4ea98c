"""Noise from outside in mechanical scenes, wider than theta: references and estimators against closed forms."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from classes import Numpy, SemiImplicitEuler

from bench.conformance import check
from bench.model import Decision, ProcessNoiseScene, State, compose


@dataclass(frozen=True)
class GustyCart(ProcessNoiseScene):
    """A constant force theta (d = 1) plus a gust per step pushes a cart from rest; f = max(0, q_N - edge)^2.

    q_N = c (theta + sigma u) + b . gust e, with b_i = dt^2 (N - i) / mass for semi-implicit and dt^2 (N - i - 1) / mass
    for explicit Euler, and c the sum of b. So q_N is normal with mean m = c theta and variance s^2 = c^2 sigma^2 + gust^2
    |b|^2, and grad J = 2 c s (z Phi(z) + phi(z)) at z = (m - edge) / s. Without gusts the cart rarely passes the edge
    and the gradient is near 0, so the reference must average over the gusts.
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
        return xp.maximum(q[0] - self.edge, 0.0 * q[0]) ** 2

    def closed_form_gradient(self, contact, integrator):
        steps = {"semi_implicit_euler": 0, "explicit_euler": 1}
        if integrator is None or integrator.name not in steps:
            return None
        b = self.dt**2 * (self.horizon - steps[integrator.name] - np.arange(self.horizon)) / self.mass
        c = float(b.sum())
        s = math.hypot(c * self.sigma, self.gust * float(np.linalg.norm(b)))
        z = (c * self.force - self.edge) / s
        below = 0.5 * math.erfc(-z / math.sqrt(2.0))
        density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
        return np.array([2.0 * c * s * (z * below + density)])


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
    assert cost == pytest.approx(np.maximum(reached - 0.75, 0.0) ** 2, rel=1e-9)


def test_gusts_need_controls():
    with pytest.raises(TypeError, match="set n_u"):

        @dataclass(frozen=True)
        class Without(ProcessNoiseScene):
            name = "without"
