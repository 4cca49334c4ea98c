"""Engines in environments of their own pass the kit, and have the gradients of the discrete spring: slow, where installed.

``BENCH_ENGINES=DIR`` names the folder of the environments, which ``python -m bench engines install`` makes.
"""

import numpy as np
import pytest
from bench.plugins.contacts.penalty import Penalty
from bench.plugins.integrators.semi_implicit_euler import SemiImplicitEuler
from bench.plugins.scenes.bounce_once import BounceOnce

import bench.conformance
from bench.conformance.subjects import law_for
from bench.model import compose, registry

ENGINES = ("brax", "drake", "mujoco_warp", "newton", "nimble", "taichi")
SPRING = (-1.56802, -1.22481, -1.22481 / 480)
"""Gradient of one bounce on an undamped spring of 1e4 N/m under semi-implicit Euler, as in the tests of MuJoCo and MJX."""
WRONG = {
    "nimble-gradient_is_that_of_value": "its Jacobians are of rigid contact, its costs bounce once per step boundary",
}
pytestmark = pytest.mark.slow


@bench.conformance.parametrize([registry.usable("backends", name) for name in ENGINES], expected_failures=WRONG)
def test_engine_conforms(plugin, check):
    check(plugin)


@pytest.mark.parametrize(("name", "error"), [("newton", 1e-5), ("taichi", 1e-6), ("brax", 1e-4)])
def test_gradient_of_one_bounce_is_that_of_the_discrete_spring(name, error):
    backend = registry.usable("backends", name)()
    if reason := backend.unavailable_reason():
        pytest.skip(reason)
    scene = BounceOnce()
    problem = backend.compile(compose(scene, law_for(scene, Penalty), SemiImplicitEuler()))
    gradient = problem.grad(problem.program.theta0, np.zeros((problem.program.n_noise, 1)))[:, 0]
    np.testing.assert_allclose(gradient, SPRING, rtol=error)
