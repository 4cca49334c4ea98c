"""Training with contact: what the log has of it, and any contact law on a backend with JAX's operations."""

import jax.numpy as jnp
import numpy as np
import pytest
from problems import environment, pressed_program

from bench.model import State, registry
from bench.training.run import Training

SHAC = {"hidden": 4, "rollouts": 4, "window": 12, "passes": 1, "batches": 1, "steps": 480}


def test_contacts_penetration_and_force_of_a_state():
    env = environment(pressed_program(stiffness=1e3))
    state = State(jnp.array([[-0.02, 0.1]]), jnp.zeros((1, 2)))
    closed, depth, force = env.contacts(state)
    np.testing.assert_allclose(closed, [1.0, 0.0])
    np.testing.assert_allclose(depth, [0.02, 0.0])
    np.testing.assert_allclose(force, [20.0, 0.0])


def updated(contact="penalty", backend="jax", **parameters):
    """The log of one update under a contact law, and the seconds of compilation."""
    env = environment(pressed_program(contact, **parameters), backend)
    run = Training(env, registry.make("trainers", "shac", SHAC))
    _, log = run.update(run.start(0))
    return {name: float(value) for name, value in log.items()}, run.compile_s


@pytest.mark.slow
def test_the_log_has_contacts_softer_ground_is_entered_deeper_and_parameter_values_share_a_compilation():
    (soft, first_s), (stiff, second_s) = (updated(stiffness=k) for k in (1e3, 1e4))
    for log, stiffness in ((soft, 1e3), (stiff, 1e4)):
        assert log["contacts"] > 0
        assert log["contact_force"] == pytest.approx(stiffness * log["penetration"])
    assert soft["penetration"] > stiff["penetration"]
    assert first_s == second_s


@pytest.mark.slow
def test_a_contact_law_that_solves_an_equation_trains_on_the_implicit_backend():
    log, _ = updated("complementarity", "implicit")
    assert 0 < log["gradient_norm"] < np.inf
    assert np.isnan(log["contact_force"])
