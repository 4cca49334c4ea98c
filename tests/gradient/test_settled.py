"""Right gradients of long, tiny or flat problems: settled by smaller steps, a complex step, or the input's own scale."""

import numpy as np
import pytest
from bench.plugins.studies.gradient_check import GradientCheck
from bench.plugins.studies.gradient_check.measure import complex_step, start

from bench import gradient as gradcheck
from bench.model import compose, registry

UNIT = float(np.finfo(float).eps)
SEARCH = GradientCheck()


def check(cost, gradient, theta):
    return gradcheck.check(cost, gradient, np.array(theta, dtype=float)).cause


@pytest.mark.parametrize("power", [3, 5])
def test_flat_point_of_a_power_is_right(power):
    # products, since powers of arrays round differently from place to place
    assert (
        check(lambda x: np.prod([x[0]] * power, axis=0), lambda x: power * x ** (power - 1), [0.0]) in gradcheck.TRUSTED
    )


def test_zero_gradient_of_a_slope_is_not_taken_for_a_flat_point():
    cause = check(lambda x: x[0] * x[0] * x[0] + 1e-6 * x[0], lambda x: 3 * x**2, [0.0])
    assert cause not in gradcheck.TRUSTED


@pytest.mark.parametrize("size", [1e-30, 1e-200])
def test_tiny_inputs_are_checked_at_their_own_scale(size):
    def cost(x):
        return np.sin(x[0] / size) + x[0] / size

    def gradient(x):
        return (np.cos(x / size) + 1.0) / size

    assert check(cost, gradient, [size]) in gradcheck.TRUSTED
    assert check(cost, lambda x: 1.1 * gradient(x), [size]) == "wrong_factor"


def test_rounding_in_place_of_0_keeps_the_scale_1():
    cause = check(lambda x: (x[0] - 1.0) ** 2, lambda x: 2 * (x - 1.0), [6e-17])
    assert cause in gradcheck.TRUSTED


def pendulum(horizon):
    scene = registry.make("scenes", "double_pendulum", {"horizon": horizon})
    return registry.make("backends", "jax", {}).compile(
        compose(scene, None, registry.make("integrators", "semi_implicit_euler"))
    )


def test_complex_step_is_the_derivative_of_the_program():
    problem = pendulum(50)
    theta = problem.program.theta0
    along = np.linspace(-1.0, 1.0, theta.size)
    slope = problem.grad(theta, np.zeros((problem.program.n_noise, 1)))[:, 0] @ along
    assert complex_step(problem, theta, along, np.zeros(problem.program.n_noise)) == pytest.approx(slope, rel=1e-10)


@pytest.mark.parametrize(
    "horizon", [pytest.param(2000, marks=pytest.mark.slow), pytest.param(3000, marks=pytest.mark.full)]
)
def test_long_chaotic_rollout_is_settled_and_its_faults_are_named(horizon, monkeypatch):
    problem = pendulum(horizon)
    theta = problem.program.theta0
    assert start(problem, theta, UNIT, SEARCH, 0).cause in gradcheck.TRUSTED
    plain = problem.grad
    for wrong in (lambda g: 1.1 * g, lambda g: g * np.r_[0.5, np.ones(len(g) - 1)][:, None]):
        monkeypatch.setattr(problem, "grad", lambda at, w, wrong=wrong: wrong(plain(at, w)))
        assert start(problem, theta, UNIT, SEARCH, 0).cause not in gradcheck.TRUSTED


def test_small_jumps_do_not_excuse_a_larger_error():
    """Three jumps of 1e-6 over two scales, beside a term of 1e-4 that the gradient lacks."""

    def cost(x):
        return np.sin(x[0]) + 1e-4 * x[0] ** 2 + 1e-6 * np.floor(2.0 * x[0] + 0.3)

    assert check(cost, np.cos, [1.0]) not in gradcheck.TRUSTED
