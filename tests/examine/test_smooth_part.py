"""Adaptive solvers: a gradient is held to the cost's smooth part, since tiny steps show one sequence of steps only."""

from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bench
from bench.gradient.smooth_part import smooth_part

OSCILLATOR, PREDATORS = np.array([5.0, 2.0, 0.0]), np.array([1.1, 0.4, 0.1, 0.4])
UNIT = float(np.finfo(np.float64).eps)


def oscillator(t, z, p):
    """Van der Pol's oscillator with the sensitivities to its parameter and first state, if ``z`` has them."""
    x, v = z[:2]
    slope = [v, p[0] * (1 - x * x) * v - x]
    if z.size == 2:
        return slope
    jacobian = np.array([[0, 1], [-2 * p[0] * x * v - 1, p[0] * (1 - x * x)]])
    return np.r_[slope, (jacobian @ z[2:].reshape(2, 3) + [[0, 0, 0], [(1 - x * x) * v, 0, 0]]).ravel()]


def predators(t, z, p):
    """Lotka and Volterra's equations with the sensitivities to all four parameters, if ``z`` has them."""
    x, y = z[:2]
    slope = [p[0] * x - p[1] * x * y, p[2] * x * y - p[3] * y]
    if z.size == 2:
        return slope
    jacobian = np.array([[p[0] - p[1] * y, -p[1] * x], [p[2] * y, p[2] * x - p[3]]])
    own = np.array([[x, -x * y, 0, 0], [0, 0, x * y, -y]])
    return np.r_[slope, (jacobian @ z[2:].reshape(2, 4) + own).ravel()]


def solved(system, method, p, tolerance=1e-6, is_gradient=False):
    if system is oscillator:
        start, end, first = p[1:], 12, [0, 1, 0, 0, 0, 1]
    else:
        start, end, first = np.array([10.0, 5.0]), 15, np.zeros(8)
    z = np.r_[start, first] if is_gradient else start
    settings = {"args": (p,), "method": method, "rtol": tolerance, "atol": tolerance / 100}
    return solve_ivp(system, (0, end), z, **settings).y[:, -1]


def cost(system, method, p, tolerance=1e-6):
    return solved(system, method, p, tolerance)[0]


def gradient(system, method, p, factor=1.0):
    slope = solved(system, method, p, is_gradient=True)[2:].reshape(2, -1)[0]
    return slope * np.r_[1.0, factor, np.ones(slope.size - 2)]


def examined(system, method, theta, factor=1.0, **settings):
    return bench.examine(
        partial(cost, system, method), theta, grad=partial(gradient, system, method, factor=factor), calls=3000,
        progress=False, **settings,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "method", "theta"),
    [(oscillator, "LSODA", OSCILLATOR), (predators, "LSODA", PREDATORS), (predators, "RK45", PREDATORS)],
)
def test_right_and_wrong_gradients_over_adaptive_steps_are_told_apart(system, method, theta):
    right = examined(system, method, theta)
    assert right.status in (0, 3), str(right)
    for factor in (1.3, 1.03):
        wrong = examined(system, method, theta, factor)
        assert (wrong.status, wrong.derivative) == (1, "wrong"), str(wrong)


@pytest.mark.slow
def test_a_refined_cost_decides():
    refined = partial(cost, oscillator, "LSODA", tolerance=1e-11)
    right = examined(oscillator, "LSODA", OSCILLATOR, refined=refined)
    assert (right.status, right.derivative) == (0, "right"), str(right)
    wrong = examined(oscillator, "LSODA", OSCILLATOR, 1.03, refined=refined)
    assert (wrong.status, wrong.derivative) == (1, "wrong"), str(wrong)


def rough(t):
    return 2.0 * np.sin(t + 0.3) + 1e-6 * np.sin(1e9 * t * (1.0 + t))


@pytest.mark.parametrize("size", [0.0, 1e-3])
def test_staircases_and_smooth_costs_have_no_rough_part(size):
    def along(t):
        return 2.0 * np.sin(t) if size == 0.0 else np.round(t / size) * size

    assert smooth_part(along, 1.0, UNIT, np.random.default_rng(0)) is None


def test_the_smooth_part_of_a_rough_cost_is_known_within_its_error():
    for seed in range(20):
        found = smooth_part(rough, 1.0, UNIT, np.random.default_rng(seed))
        assert abs(found.slope - 2.0 * np.cos(0.3)) <= found.error, seed
        assert found.error < 1e-3
