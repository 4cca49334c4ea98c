"""The gradient of a window: against central differences, against the sweep's program, and at the ends of episodes."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

from bench.model import State, registry
from bench.training import windows
from bench.training.environment import Episodes
from bench.training.networks import Actor

DIFFERENCE = 1e-5
"""Relative error allowed to a central difference of step 1e-6 in float64: curvature and rounding give 1e-7 to 1e-6."""
ROUNDING = 1e-10
"""Relative error allowed to two orders of the same float64 operations."""


def environment(horizon=240, **parameters):
    parameters = {"substeps": 1, **parameters}  # a quarter of the program to compile
    return problems.environment(problems.cartpole_program(horizon=horizon, **parameters))


def start(env, count=6):
    return env.start(jnp.asarray(np.random.default_rng(0).standard_normal((8, count))))


def window_return(env, actor, length, key, cut=0.0, first=None, discount=0.99):
    """Return gains of a window without a value at its end, and the window."""
    first = start(env) if first is None else first
    _, window = windows.rollout(env, actor.sample, first, length, key, cut)
    return windows.gains(window, jnp.zeros_like(window.reward), discount).sum(), window


@pytest.fixture
def actor():
    return Actor(jax.random.PRNGKey(1), [5, 8, 1], "float64")


@pytest.mark.slow
def test_the_gradient_of_a_window_is_that_of_fobg_on_the_whole_program():
    """Without discount and value, a window as long as the horizon has the cost of the sweep's own program."""
    steps, count, sigma = 5, 6, 0.3
    program = problems.cartpole_program(horizon=steps, substeps=1, sigma=sigma, policy="mlp[hidden=4]")
    backend, key = registry.make("backends", "jax"), jax.random.PRNGKey(2)
    env, scene = problems.environment(program), program.scene
    noise = np.asarray(env.normal(jax.random.split(key)[0], (steps, 1, count)))
    numbers = np.random.default_rng(0).standard_normal((8, count))
    w = np.concatenate([noise.reshape(steps, count), numbers])
    problem, theta = backend.compile(program), scene.theta0() + 0.1
    fobg = registry.make("estimators", "fobg").estimate(problem, theta, np.moveaxis(w, 0, -1)[None])[0]

    def mean_return(theta):
        def policy(observation, noise):
            return scene.plugin.act(jnp, theta[:, None], observation) + sigma * noise

        _, window = windows.rollout(env, policy, env.start(jnp.asarray(numbers)), steps, key)
        return windows.gains(window, jnp.zeros_like(window.reward), 1.0).sum(axis=0).mean()

    gradient = -np.asarray(jax.grad(mean_return)(jnp.asarray(theta)))
    assert np.abs(fobg).max() > 0
    np.testing.assert_allclose(gradient, fobg, rtol=ROUNDING, atol=ROUNDING * np.abs(fobg).max())


@pytest.mark.slow
def test_no_gradient_crosses_the_end_of_an_episode(actor):
    """With an end after step 2, the derivative of all later rewards by the state at the window's start is zero."""
    env = environment(horizon=2)
    first = start(env)

    def late_reward(q, leak=False):
        moved, total = Episodes(State(q, first.state.v), first.age), 0.0
        for t in range(3):
            u = actor.mean(env.observe(moved.state))
            result = env.step(moved, u, jnp.zeros((8, 6)))
            total += result.reward.sum() if t >= 2 else 0.0
            after = result.next
            if leak and t == 1:
                # a planted fault: the start after the reset depends on the state before it
                after = Episodes(State(after.state.q + 0.1 * result.reached.q, after.state.v), after.age)
            moved = after
        return total

    slope = jax.jit(jax.grad(late_reward), static_argnums=1)
    assert float(jnp.abs(slope(first.state.q, False)).max()) == 0.0
    assert float(jnp.abs(slope(first.state.q, True)).max()) > 0.0


def test_the_return_of_a_window_restarts_at_an_end_with_the_value_of_the_state_before_the_reset(actor):
    env, key = environment(horizon=3), jax.random.PRNGKey(2)
    _, window = window_return(env, actor, 5, key)
    assert np.asarray(window.ended)[:, 0].tolist() == [False, False, True, False, False]
    value = jnp.asarray(np.random.default_rng(5).standard_normal(window.reward.shape))
    gained = windows.gains(window, value, 0.9).sum(axis=0)
    r, v = np.asarray(window.reward), np.asarray(value)
    expected = r[0] + 0.9 * r[1] + 0.81 * r[2] + 0.729 * v[2] + r[3] + 0.9 * r[4] + 0.81 * v[4]
    np.testing.assert_allclose(gained, expected, rtol=ROUNDING)
    # the reached observation is that of the state before the reset: its angle is still close to the previous one
    np.testing.assert_allclose(window.reached[1], window.observation[2], rtol=ROUNDING, atol=ROUNDING)
    assert not np.allclose(window.reached[2], window.observation[3])


@pytest.mark.slow
def test_the_gradient_of_an_episode_in_windows_is_the_sum_of_theirs(actor):
    """By a loop over windows whose first states are constants: rewards and the last value, times gamma^steps before."""
    env, key, length, every, discount = environment(), jax.random.PRNGKey(2), 10, 4, 0.9
    first = start(env, 3)
    noise = env.normal(jax.random.split(key)[0], (length, 1, 3))

    def value(seen):
        return jnp.sin(seen).sum(axis=-2)

    def in_windows(actor):
        _, window = windows.rollout(env, actor.sample, first, length, key, every=every)
        return windows.gains(window, value(window.reached), discount, every).sum()

    def by_hand(actor):
        episodes, total = first, 0.0
        for t in range(length):
            if t % every == 0:
                episodes = jax.lax.stop_gradient(episodes)
            moved = env.step(episodes, actor.sample(env.observe(episodes.state), noise[t]), jnp.zeros((8, 3)))
            total += discount**t * moved.reward.sum()
            if (t + 1) % every == 0 or t + 1 == length:
                total += discount ** (t + 1) * value(env.observe(moved.reached)).sum()
            episodes = moved.next
        return total

    found, expected = jax.jit(jax.grad(in_windows))(actor), jax.jit(jax.grad(by_hand))(actor)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8 * np.abs(other).max())
    free = jax.jit(jax.grad(lambda a: window_return(env, a, length, key, first=first, discount=discount)[0]))(actor)
    assert not np.allclose(jax.tree.leaves(found)[0], jax.tree.leaves(free)[0], rtol=1e-3)


@pytest.mark.slow
def test_the_norm_of_a_jacobian_agrees_with_differences():
    env = environment()
    state = start(env, 2).state
    u, step = jnp.full((1, 2), 0.3), 1e-6
    x = np.concatenate(state)

    def advance(x):
        return np.concatenate(env.program.step(env.ops, State(jnp.asarray(x[:2]), jnp.asarray(x[2:])), u))

    columns = [(advance(x + step * e[:, None]) - advance(x - step * e[:, None])) / (2 * step) for e in np.eye(4)]
    expected = np.sqrt((np.array(columns) ** 2).sum(axis=(0, 1)))
    np.testing.assert_allclose(windows.jacobian_norm(env, state, u), expected, rtol=DIFFERENCE)


def test_a_state_that_is_not_finite_ends_its_episode():
    env = environment()
    first = env.start(jnp.zeros((8, 2)))
    broken = Episodes(State(first.state.q.at[0, 1].set(jnp.nan), first.state.v), first.age)
    moved = env.step(broken, jnp.zeros((1, 2)), jnp.ones((8, 2)))
    assert np.asarray(moved.terminated).tolist() == [False, True]
    assert np.isfinite(np.concatenate(moved.next.state)).all()
