"""The example of a predictive controller: its derivative on both sides of a switch of the active set, and at the switch."""

import runpy
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.optimize import lsq_linear, minimize

import bench

MPC = runpy.run_path(str(Path(__file__).resolve().parents[2] / "examples" / "mpc.py"))
EXPERT = np.array([0.0, 2.0, -2.0, -1.0])
SAME = 1e-9
"""Absolute difference in N allowed from another solver of the same program, whose Hessian has a condition of 1e3."""
DIFFERENCES = 1e-6
"""Relative error of central differences with a step of 1e-5 in float64: 1e-10 from the step, 1e-8 from rounding."""
BESIDE = 1e-3
"""Distance of the examined points from a switch in log-weights, 100 steps of the differences."""
QUICK = {"calls": 1500}

value = jax.jit(MPC["cost"])
slope = jax.jit(jax.grad(MPC["cost"]))
faulty_slope = jax.jit(jax.grad(lambda theta: MPC["cost"](theta, by_limits=False)))
plans = jax.jit(jax.vmap(MPC["plan"], (None, 0)))


def active(theta):
    """Which forces are at a limit, ``(16, 12)``."""
    return np.asarray(abs(plans(theta, MPC["STARTS"])) >= MPC["LIMIT"])


@pytest.fixture(scope="module")
def switch():
    """A theta at which one force reaches or leaves its limit, found by halving along the weight of the angle."""
    axis = np.array([0.0, 1.0, 0.0, 0.0])
    places = np.linspace(0.0, 5.0, 51)
    sets = [active(place * axis) for place in places]
    first = next(i for i in range(1, len(sets)) if (sets[i] != sets[0]).any())
    inner, outer = places[first - 1], places[first]
    for _ in range(50):
        middle = 0.5 * (inner + outer)
        inner, outer = (middle, outer) if (active(middle * axis) == sets[0]).all() else (inner, middle)
    return outer * axis


def differences(theta, step=1e-5):
    return np.array([(value(theta + step * e) - value(theta - step * e)) / (2 * step) for e in np.eye(4)])


def test_forces_solve_the_quadratic_program():
    """Against scipy's bounded least squares, an active-set method, on the same states."""
    weights = np.sqrt(np.tile(np.exp(EXPERT), MPC["STEPS"]))
    for start, forces in zip(MPC["STARTS"], plans(EXPERT, MPC["STARTS"]), strict=True):
        rows = np.concatenate([weights[:, None] * MPC["FORCED"], np.sqrt(0.1) * np.eye(MPC["STEPS"])])
        right = np.concatenate([-weights * (MPC["FREE"] @ start), np.zeros(MPC["STEPS"])])
        limits = (-MPC["LIMIT"], MPC["LIMIT"])
        expected = lsq_linear(rows, right, limits, method="bvls", tol=1e-15).x
        np.testing.assert_allclose(forces, expected, atol=SAME)


@pytest.mark.slow
@pytest.mark.parametrize("side", [-1, 1])
def test_the_derivative_is_that_of_the_forces_on_both_sides_of_a_switch(switch, side):
    theta = switch + side * BESIDE * np.array([0.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(
        slope(theta), differences(theta), rtol=DIFFERENCES, atol=DIFFERENCES * abs(slope(theta)).max()
    )
    assert active(theta).sum() > 0, "some forces are at their limits"
    error = abs(faulty_slope(theta) - slope(theta)).max()
    assert error > 0.01 * abs(slope(theta)).max(), "the planted fault is one"


@pytest.mark.slow
def test_the_examination_confirms_the_derivative_and_names_the_planted_fault():
    right = bench.examine(MPC["cost"], np.zeros(4), grad="jax", **QUICK)
    assert right.status == 0, str(right)
    faulty = bench.examine(lambda theta: MPC["cost"](theta, by_limits=False), np.zeros(4), grad="jax", **QUICK)
    assert faulty.status == 1, str(faulty)
    assert "WRONG. missing_term" in str(faulty).splitlines()[0]


@pytest.mark.slow
def test_the_switch_is_a_kink(switch):
    report = bench.examine(MPC["cost"], switch, grad="jax", **QUICK)
    assert report.cause == "kink", str(report)


@pytest.mark.slow
def test_descent_recovers_the_weights_of_the_expert_and_not_with_the_planted_fault():
    def descent(gradient):
        return minimize(lambda theta: (float(value(theta)), np.asarray(gradient(theta))), np.zeros(4), jac=True)

    np.testing.assert_allclose(descent(slope).x, EXPERT, atol=1e-2)
    assert abs(descent(faulty_slope).x - EXPERT).max() > 0.1
