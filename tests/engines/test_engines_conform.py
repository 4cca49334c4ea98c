"""Engines in environments of their own pass the kit, and have the gradients of the discrete spring: slow, where installed.

``BENCH_ENGINES=DIR`` names the folder of the environments, which ``python -m bench engines install`` makes.
"""

import numpy as np
import pytest
from classes import BounceOnce, Impulse, Numpy, Penalty, Pushing, SemiImplicitEuler

import bench.conformance
from bench.conformance.subjects import law_for
from bench.engines import table
from bench.engines.conformance import runner
from bench.experiment import by_name
from bench.model import compose, registry

ENGINES = ("brax", "drake", "genesis", "mujoco_warp", "newton", "taichi")
pytestmark = pytest.mark.slow


@bench.conformance.parametrize([registry.usable("backends", name) for name in ENGINES])
def test_engine_conforms(plugin, check):
    check(plugin)


def installed(name):
    backend = by_name.make("backends", name)
    if reason := backend.unavailable_reason():
        pytest.skip(reason)
    return backend


def test_a_bounce_of_the_xpbd_solver_is_rigid():
    """It corrects the position within the ground after its step, and not by the time of impact: by less than v dt."""
    backend, scene = installed("newton[solver=xpbd]"), BounceOnce()
    of = compose(scene, law_for(scene, Impulse), SemiImplicitEuler())
    still = np.zeros((of.n_noise, 1))
    own, rigid = (b.compile(of).trajectory(of.theta0, still).states for b in (backend, Numpy()))
    np.testing.assert_allclose(own[-1, 1], rigid[-1, 1], rtol=1e-6)
    assert np.abs(own[:, 0] - rigid[:, 0]).max() < abs(scene.velocity) * scene.dt


def test_balls_of_a_tenth_of_a_kilogram_touch_in_brax():
    """With Brax's own 20 halvings, the second ball stays where it is."""
    scene = Pushing()
    of = compose(scene, law_for(scene, Penalty), SemiImplicitEuler())
    still = np.zeros((of.n_noise, 1))
    ends = [
        installed(name).compile(of).trajectory(of.theta0, still).states[-1, 1, 0]
        for name in ("brax[halvings=20]", "brax")
    ]
    own = Numpy().compile(of).trajectory(of.theta0, still).states[-1, 1, 0]
    assert ends[0] == 1.0
    assert abs(ends[1] - own) < 0.1 * abs(own - 1.0)


@pytest.mark.parametrize("name", ["brax", "drake", "mujoco_warp", "newton"])
def test_a_slide_on_a_hinge_is_right_except_in_brax(name):
    """Its axis does not turn in Brax: were it repaired, the documentation would be wrong. Two sliders have one motor."""
    assert installed(name)
    rows = table.Engine(name).rows(runner, "offset_slide", "tendon_limit")
    n = 1 if name == "mujoco_warp" else 4
    assert [row["case"] for row in rows] == ["offset_slide"] * n + ["tendon_limit"] * n
    assert {row["is_right"] for row in rows[:n]} == {name != "brax"}
    assert not [row for row in rows[n:] if row["is_right"] is False]
