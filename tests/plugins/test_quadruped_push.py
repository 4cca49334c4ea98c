"""The robot that pushes a block: without contact the block's term has no gradient, and in contact a right one."""

import numpy as np
from classes import QuadrupedPush
from helpers import central_differences, need_backends

import bench

need_backends("mujoco")

STILL = np.zeros((12, 1))
DOWN = {"effort": 0.0, "upright": 0.0}
"""Weights that leave only the block's term."""


def problem(**values):
    return bench.problem(QuadrupedPush(**values), backend="mujoco[impedance=0.9]")


def test_the_block_has_no_gradient_without_contact():
    """Exactly 0, at the start and at plans with the scene's own noise, none of which touches."""
    pushing = problem(**DOWN)
    w = np.random.default_rng(0).standard_normal((12, 4))
    np.testing.assert_array_equal(pushing.value(pushing.program.theta0, w), 1.0)
    np.testing.assert_array_equal(pushing.grad(pushing.program.theta0, w), 0.0)
    # the other terms have one
    assert np.linalg.norm(problem().grad(pushing.program.theta0, STILL)) > 1e-2


def test_in_contact_the_gradient_moves_the_block():
    pushing = problem(lean=0.2, **DOWN)
    theta = pushing.program.theta0
    gradient = pushing.grad(theta, STILL)
    np.testing.assert_allclose(
        gradient, central_differences(pushing, theta, STILL), rtol=0, atol=1e-4 * np.linalg.norm(gradient)
    )
    moved = theta[:, None] - 0.02 * gradient / np.linalg.norm(gradient)
    assert pushing.value(moved, STILL)[0] < pushing.value(theta, STILL)[0] - 0.02
