"""Training with contact: what the log has of it, and any contact law on a backend with JAX's operations."""

import jax.numpy as jnp
import numpy as np
import pytest
from problems import pressed_program

from bench.model import State, registry
from bench.training.environment import Environment
from bench.training.run import Training

SHAC = {"hidden": 4, "rollouts": 4, "window": 12, "passes": 1, "batches": 1, "steps": 480}


def test_contacts_penetration_and_force_of_a_state():
    env = Environment(pressed_program(stiffness=1e3), registry.make("backends", "jax").ops())
    state = State(jnp.array([[-0.02, 0.1]]), jnp.zeros((1, 2)))
    closed, depth, force = env.contacts(state)
    np.testing.assert_allclose(closed, [1.0, 0.0])
    np.testing.assert_allclose(depth, [0.02, 0.0])
    np.testing.assert_allclose(force, [20.0, 0.0])


def test_the_log_has_the_contact_of_a_window_and_softer_ground_is_entered_deeper():
    depth = {}
    for stiffness in (1e3, 1e4):
        env = Environment(pressed_program(stiffness=stiffness), registry.make("backends", "jax").ops())
        run = Training(env, registry.make("trainers", "shac", SHAC))
        _, log = run.update(run.start(0))
        assert float(log["contacts"]) > 0
        assert float(log["contact_force"]) == pytest.approx(stiffness * float(log["penetration"]))
        depth[stiffness] = float(log["penetration"])
    assert depth[1e3] > depth[1e4]


def test_parameter_values_share_a_compilation():
    runs = [
        Training(
            Environment(pressed_program(stiffness=k), registry.make("backends", "jax").ops()),
            registry.make("trainers", "shac", SHAC),
        )
        for k in (2e3, 3e3)
    ]
    seconds = []
    for run in runs:
        run.update(run.start(0))
        seconds.append(run.compile_s)
    assert seconds[0] == seconds[1]


@pytest.mark.slow
def test_a_contact_law_that_solves_an_equation_trains_on_the_implicit_backend():
    env = Environment(pressed_program("complementarity"), registry.make("backends", "implicit").ops())
    run = Training(env, registry.make("trainers", "shac", SHAC))
    _, log = run.update(run.start(0))
    assert np.isfinite(float(log["gradient_norm"]))
    assert float(log["gradient_norm"]) > 0
    assert np.isnan(float(log["contact_force"]))
