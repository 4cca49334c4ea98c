"""Noise from outside in mechanical scenes, wider than theta: references and estimators against closed forms."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from bench.plugins.backends.jax import Jax
from bench.plugins.backends.numpy import Numpy
from bench.plugins.estimators.fobg import Fobg
from bench.plugins.estimators.reinforce import Reinforce
from bench.plugins.integrators.explicit_euler import ExplicitEuler
from bench.plugins.integrators.semi_implicit_euler import SemiImplicitEuler

from bench.measure.reference import certify
from bench.model import Decision, ProcessNoiseScene, State, compose

ERRORS = 4.5
"""Standard errors: below 1e-5 by chance."""
SAMPLES = 1 << 17


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


def off(found, truth):
    """The difference in standard errors of a reference."""
    return abs(found.gradient[0] - truth) / found.known().standard_error


def sampled(scene, integrator):
    """The reference by sampling, of a program that is not allowed to know its closed form, and what the scene knows."""
    program = compose(scene, None, integrator)
    truth = program.closed_form_gradient()
    program.closed_form_gradient = lambda: None
    return certify(Numpy().compile(program), frozenset({"value"}), SAMPLES, 1e-9), truth


@pytest.mark.parametrize("integrator", [SemiImplicitEuler(), ExplicitEuler()], ids=str)
def test_the_sampled_reference_averages_over_gusts(integrator):
    found, truth = sampled(GustyCart(horizon=5, dt=0.2), integrator)
    assert off(found, truth[0]) < ERRORS
    # without gusts the gradient is another one: a reference that left them out would be caught
    still = compose(GustyCart(horizon=5, dt=0.2, gust=0.0), None, integrator).closed_form_gradient()
    assert off(found, still[0]) > 2 * ERRORS


@pytest.mark.parametrize("estimator", [Fobg(), Reinforce()], ids=str)
def test_estimators_are_unbiased_and_shift_no_gust(estimator):
    program = compose(GustyCart(horizon=5, dt=0.2), None, SemiImplicitEuler())
    problem = Numpy().compile(program)
    assert (problem.dim, program.n_noise, program.exogenous) == (1, 6, 5)
    noise = np.random.default_rng(3).standard_normal((64, 256, 6))
    values = estimator.estimate(problem, program.theta0, noise)[:, 0]
    error = values.std(ddof=1) / np.sqrt(len(values))
    assert abs(values.mean() - program.closed_form_gradient()[0]) < ERRORS * error
    w = noise[0].T
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


def test_compiled_rollouts_have_the_same_gusts():
    program = compose(GustyCart(horizon=5, dt=0.2), None, SemiImplicitEuler())
    w = np.random.default_rng(5).standard_normal((6, 16))
    found, expected = (backend.compile(program).value(program.theta0, w) for backend in (Jax(), Numpy()))
    assert found == pytest.approx(expected, rel=1e-12)


def test_gusts_need_controls():
    with pytest.raises(TypeError, match="set n_u"):

        @dataclass(frozen=True)
        class Without(ProcessNoiseScene):
            name = "without"
