"""Returns of a policy, and environments."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from classes import CartpoleSwing, SemiImplicitEuler
from problems import cartpole_program, environment

from bench.errors import UserError
from bench.model import LoopOps, State, compose
from bench.training import steps

ROUNDING = 1e-9
"""Relative difference allowed between a loop in NumPy and a scan in JAX, both in float64, over 30 steps."""


def test_returns_are_those_of_a_loop_in_numpy():
    env = environment(cartpole_program(horizon=30))
    numbers = np.random.default_rng(0).standard_normal((8, 5))
    ours = env.returns(lambda seen: 0.2 * seen[:1] - seen[4:], jnp.asarray(numbers))
    scene, program, ops = env.scene, env.program, LoopOps(np)
    state, total = scene.random_start(np, numbers), 0.0
    for _ in range(30):
        seen = scene.observation(np, *state)
        u = 0.2 * seen[:1] - seen[4:]
        total = total - scene.stage_cost(np, state.q, state.v, u)
        state = program.step(ops, state, u)
    np.testing.assert_allclose(ours, total, rtol=ROUNDING)


def test_an_episode_counts_up_to_its_first_end_also_without_random_starts():
    @dataclass(frozen=True)
    class Falls(CartpoleSwing):
        name = "falls"
        exogenous = 0

        def has_ended(self, xp, q, v):
            return q[0] > 0.05

        def initial_state(self, xp, theta):
            return State(0.0 * theta[:1] + xp.zeros((2, 1)), 0.0 * theta[:1] + xp.asarray([[1.1], [0.0]]))

        def stage_cost(self, xp, q, v, u):
            return 1.0 + 0.0 * v[0]

    env = environment(compose(Falls(horizon=50), None, SemiImplicitEuler()))
    returns = np.asarray(env.returns(lambda seen: 0.0 * seen[:1], jnp.zeros((0, 3))))
    # at 1.1 m/s the cart passes 0.05 m in the third step of 1/60 s
    assert returns.tolist() == [-3.0] * 3


def test_more_batches_than_states_are_refused():
    with pytest.raises(UserError, match="batches = 9, but a window has 8 states"):
        steps.batches_of(jax.random.PRNGKey(0), 8, passes=2, batches=9)
    assert steps.batches_of(jax.random.PRNGKey(0), 8, passes=2, batches=8).shape == (16, 1)
