"""Physics engines: their twins are the scenes' programs, their gradients are right, and what they cannot do is refused."""

import numpy as np
import pytest
from bench.plugins.backends import mujoco
from bench.plugins.studies.bias_variance import BiasVariance
from classes import (
    BounceOnce,
    BouncingBall,
    Fobg,
    Jax,
    Mjx,
    Mujoco,
    Numpy,
    Penalty,
    Pendulum,
    Pushing,
    Quadruped,
    SemiImplicitEuler,
)
from helpers import need_backends

from bench.conformance import backends, scenes
from bench.conformance.kit import Failed
from bench.conformance.subjects import distance, law_for, samples
from bench.experiment.cell import Cell
from bench.experiment.experiment import Budget
from bench.model import compose
from bench.plugins import mjcf

need_backends("mujoco", "mjx")

SPRING = (-1.56802, -1.22481, -1.22481 / 480)
"""Gradient of one bounce on an undamped spring of 1e4 N/m under semi-implicit Euler, made once by hand-written code.

A force in the first step is a first velocity dt / m higher: -0.002552 to the digits that were kept.
"""
ENGINES = [Mujoco(), pytest.param(Mjx(), marks=pytest.mark.slow)]


def program(scene, **law):
    made = law_for(scene, Penalty, {"damping_mode": "clipped", **law}) if scene.n_contacts else None
    return compose(scene, made, SemiImplicitEuler())


# ---------------------------------------------------------------------------------------------------- numbers


@pytest.mark.parametrize(
    "engine", [*ENGINES, Mujoco(gradient="rollouts"), Mujoco(differences="forward"), Jax()], ids=repr
)
def test_gradient_of_one_bounce_is_that_of_the_spring(engine):
    scene = BounceOnce()
    found = engine.compile(program(scene, stiffness=1e4)).grad(scene.theta0(), np.zeros((3, 1)))[:, 0]
    np.testing.assert_allclose(found, SPRING, rtol=1e-4)


@pytest.mark.parametrize("changed", [{"mass": 0.5}, {"gravity": 3.0}, {"dt": 0.001}, {"height": 0.4}], ids=str)
def test_twin_takes_its_numbers_from_the_scene(changed):
    of = program(BouncingBall(horizon=300, **changed), stiffness=2e3, damping=3.0)
    theta, w = samples(of)
    engine, own = (backend.compile(of).value(theta, w) for backend in (Mujoco(), Numpy()))
    assert distance(engine, own) < 1e-2


@pytest.mark.parametrize("engine", ENGINES, ids=repr)
def test_rollout_that_diverges_is_nan_and_not_frozen(engine, tmp_path, monkeypatch):
    """MuJoCo resets a state beyond 1e10, or repeats the last one, and writes a log: finite costs that mean nothing."""
    monkeypatch.chdir(tmp_path)
    of = program(Pendulum(damping=1e3, horizon=20))
    theta, w = samples(of)
    value = engine.compile(of).value(theta, w)
    own = Jax().compile(of).value(theta, w)
    assert (~np.isfinite(value) | (np.abs(value - own) < 1e-2 * np.abs(own))).all()
    assert (np.abs(own) > 1e20).all()
    assert not list(tmp_path.iterdir())


def test_lean_changes_no_number():
    of = program(Pushing())
    theta, w = samples(of)
    lean, full = (Mujoco(lean=flag).compile(of).value(theta, w) for flag in (True, False))
    np.testing.assert_array_equal(lean, full)


# --------------------------------------------------------------------------------------------------- refusals


def test_reference_of_an_engine_is_its_own():
    parts = {"scene": Pushing(), "contact": Penalty(), "integrator": SemiImplicitEuler(), "estimator": Fobg()}
    own, engine, other = (
        Cell(parts | {"backend": backend}, 8, 2, 0, BiasVariance(), budget=Budget(4096, 0.01))
        for backend in (Jax(), Mujoco(), Mujoco(impedance=0.9))
    )
    assert own.reference_key == own.with_part("backend", Numpy()).reference_key
    assert len({one.reference_key for one in (own, engine, other)}) == 3


def test_force_of_unscaled_edges_fails_the_kit(monkeypatch):
    monkeypatch.setattr(mjcf, "_cone_factor", lambda model: np.ones(model.npair))
    with pytest.raises(Failed, match=r"63\.97 \(10\)"):
        backends.frictional_contact_has_the_force_of_its_law(Mujoco())


def test_gradient_of_a_failed_rollout_that_is_a_number_fails_the_kit(monkeypatch):
    grad = mujoco.MujocoProblem._grad
    monkeypatch.setattr(mujoco.MujocoProblem, "_grad", lambda *given: np.nan_to_num(grad(*given)))
    monkeypatch.setattr(backends, "all_programs", lambda: [program(Pendulum(horizon=20))])
    with pytest.raises(Failed, match="has a finite gradient"):
        backends.failed_rollouts_have_no_gradient(Mujoco())


def test_differences_that_straddle_a_switch_of_contact_are_taken_again():
    """Central differences of a step were 50 times too large where a foot touches within the differences."""
    robot = compose(Quadruped(), Penalty(**Quadruped.contact_values), SemiImplicitEuler())
    theta, w = samples(robot)
    coarse, fine = (Mujoco(step=step).compile(robot).grad(theta, w) for step in (1e-5, 1e-9))
    assert distance(coarse, fine) < 1e-4


def test_engine_scene_that_jax_cannot_trace_fails_its_check():
    """A parameter under ``numpy``: MJX traces all parameters."""

    class Concrete(Quadruped):
        def initial_state(self, xp, theta):
            state = super().initial_state(xp, theta)
            return state._replace(q=state.q + float(np.cos(self.bend)))

    assert "parameters traced" in scenes.start_and_costs_are_traceable(Quadruped())
    with pytest.raises(Failed, match="JAX cannot trace it"):
        scenes.start_and_costs_are_traceable(Concrete())
