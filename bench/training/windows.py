"""Rolls a policy out over a window of control steps, as the objective of a first-order step and as data of a critic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bench.model.ops import Array, State
from bench.training.environment import Environment, Episodes
from bench.training.normaliser import normalised

Policy = Callable[[Array, Array], Array]
"""Actions ``(n_u, B)`` of observations ``(n_observations, B)`` and standard normal noise ``(n_u, B)``."""


class Window(NamedTuple):
    """What ``h`` control steps of B rollouts gave, each ``(h, B)`` or ``(h, n, B)``."""

    observation: Array
    """Observations before each step."""
    action: Array
    reward: Array
    reached: Array
    """Observations that each step reached, before a reset."""
    ended: Array
    """Whether the episode ended at this step."""
    terminated: Array
    """Whether it ended before its time limit, so that no value follows."""
    cut: Array
    """Whether the gradient is cut after this step: at an end, or where the step's Jacobian is too large."""
    contacts: Array
    penetration: Array
    contact_force: Array


def rollout(
    env: Environment, policy: Policy, first: Episodes, length: int, key: Array, cut: float = 0.0, every: int = 0
) -> tuple[Episodes, Window]:
    """Return the episodes after ``length`` control steps, and what the steps gave.

    A positive ``cut`` cuts the gradient after a step whose Jacobian has a larger Frobenius norm, per rollout (Georgiev
    et al. 2024, arXiv 2405.17784: adaptive horizons). A positive ``every`` cuts it after each ``every`` steps, as windows of
    that length do.
    """
    key_action, key_start = jax.random.split(key)
    count = first.age.shape[0]
    noise = env.normal(key_action, (length, env.n_actions, count))
    numbers = env.normal(key_start, (length, env.n_start, count))

    def step(episodes: Episodes, drawn: tuple[Array, Array, Array]) -> tuple[Episodes, Window]:
        observation = env.observe(episodes.state)
        action = policy(observation, drawn[0])
        moved = env.step(episodes, action, drawn[1])
        following, is_cut = moved.next, moved.ended
        if cut > 0:
            is_stiff = jacobian_norm(env, episodes.state, action) > cut
            following, is_cut = _constant_where(is_stiff, following), is_cut | is_stiff
        if every > 0:
            following = _constant_where((drawn[2] + 1) % every == 0, following)
        contacts = jax.lax.stop_gradient(env.contacts(moved.reached))
        reached = env.observe(moved.reached)
        return following, Window(
            observation, action, moved.reward, reached, moved.ended, moved.terminated, is_cut, *contacts
        )

    # the state at the start of a window is a constant
    last, window = jax.lax.scan(step, jax.lax.stop_gradient(first), (noise, numbers, jnp.arange(length)))
    return jax.lax.stop_gradient(last), window


def _constant_where(is_cut: Array, episodes: Episodes) -> Episodes:
    """Return the same episodes, whose states have no derivative where ``is_cut``."""
    parts = [jnp.where(is_cut, jax.lax.stop_gradient(part), part) for part in episodes.state]
    return Episodes(State(*parts), episodes.age)


def jacobian_norm(env: Environment, state: State, action: Array) -> Array:
    """Return the Frobenius norm of the derivative of the state after a control step by the state before it, ``(B,)``."""
    state, controls = jax.lax.stop_gradient((state, env.scene.controls_of(env.ops.xp, action)))
    split = state.q.shape[0]
    x = jnp.concatenate(state)

    def advance(x: Array) -> Array:
        return jnp.concatenate(env.program.step(env.ops, State(x[:split], x[split:]), controls))

    basis = jnp.eye(x.shape[0], dtype=x.dtype)[:, :, None] + jnp.zeros_like(x)
    columns = jax.vmap(lambda e: jax.jvp(advance, (x,), (e,))[1])(basis)
    return jnp.sqrt((columns**2).sum(axis=(0, 1)))


def gains(window: Window, values: Array, discount: Any, every: int = 0) -> Array:
    """Return what each step adds to the discounted return of its part of the window, ``(h, B)``.

    ``values (h, B)`` are of the reached states, 0 where none follows. A part lasts from the window's start or a cut to
    the next cut or the window's end; its return is ``sum_t gamma^t r_t + gamma^n V`` (Xu et al. 2022, equation 5).
    With a positive ``every``, V is added after each ``every`` steps too, and the powers of gamma go on: where the rollout
    cuts the gradient there as well, the derivative of the sum is that of all its windows of that length.
    """
    step = jnp.arange(1, window.reward.shape[0] + 1)
    is_last = step == window.reward.shape[0]
    if every > 0:
        is_last |= step % every == 0

    def add(factor: Array, at: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        reward, value, cut, last = at
        gained = factor * reward + jnp.where(cut | last, factor * discount * value, 0.0)
        return jnp.where(cut, 1.0, factor * discount).astype(reward.dtype), gained

    _, gained = jax.lax.scan(add, jnp.ones_like(window.reward[0]), (window.reward, values, window.cut, is_last))
    return gained


def gains_to_go(gained: Array, cut: Array) -> Array:
    """Return the sum of :func:`gains` from each step to the end of its part, ``(h, B)``."""

    def back(later: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
        return (at[0] + jnp.where(at[1], 0.0, later),) * 2

    return jax.lax.scan(back, jnp.zeros_like(gained[0]), (gained, cut), reverse=True)[1]


def log_probability(actor: Any, known: Any, window: Window) -> Array:
    """Return the log densities of a window's actions under an actor, ``(h, B)``; states and actions are constants."""
    seen, action = jax.lax.stop_gradient((normalised(known, flat(window.observation)), flat(window.action)))
    return actor.log_probability(seen, action).reshape(window.reward.shape)


def flat(steps: Array) -> Array:
    """Return vectors of steps ``(h, n, B)`` as columns ``(n, h * B)``."""
    return jnp.moveaxis(steps, 1, 0).reshape(steps.shape[1], -1)


def log_of(window: Window) -> dict[str, Array]:
    """Return the part of an update's log that comes from its rollouts."""
    return {
        "reward": window.reward.mean(),
        "cut": window.cut[:-1].any(axis=0).mean(dtype=window.reward.dtype),
        "contacts": window.contacts.mean(),
        "penetration": window.penetration.max(),
        "contact_force": window.contact_force.max(),
    }


def td_lambda(reward: Array, value: Array, ended: Array, discount: Any, decay: float) -> Array:
    """Return the lambda-returns of a window's states, ``(h, B)``.

    ``G_t = r_t + gamma ((1 - lambda) V_t + lambda G_{t+1})``, where ``V_t`` is the value of the state that step t
    reached, 0 where none follows. After the window's last step, and after a step that ended an episode, the return is
    ``r_t + gamma V_t`` (Sutton, Barto 2018, equation 12.9 in recursive form). Less the values before each step these are generalised
    advantages (Schulman et al. 2016, arXiv 1506.02438, equation 16).
    """

    def back(following: Array, at: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        r, v, end = at
        later = jnp.where(end, v, (1.0 - decay) * v + decay * following)
        return (r + discount * later,) * 2

    _, targets = jax.lax.scan(back, value[-1], (reward, value, ended), reverse=True)
    return targets
