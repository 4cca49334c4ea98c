"""The environment of a policy problem: batched control steps, episodes with random starts, observations and rewards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from bench.model import ContactScene, ForceLaw, State
from bench.model.ops import Array
from bench.model.policy import PolicyScene


class Episodes(NamedTuple):
    """Running episodes: their states, and the control steps since their starts, ``(B,)``."""

    state: State
    age: Array


class Transition(NamedTuple):
    """What one control step gives. All but ``next`` describe the state before a reset."""

    next: Episodes
    """The episodes after the step; those that ended are at new starts."""
    reached: State
    """The state that the step reached."""
    reward: Array
    """``(B,)``."""
    ended: Array
    """Whether the episode is over: terminated, or at its time limit, ``(B,)``."""
    terminated: Array
    """Whether the episode ended before its time limit, so that no value follows, ``(B,)``."""


@dataclass(frozen=True, eq=False)
class Environment:
    """The episodes of a policy problem in JAX, as pure functions. Arrays are component-first and batch-last.

    A state that is not finite terminates its episode. The gradient is cut at resets: a start depends on no earlier
    state, and the selection of the start passes none back.
    """

    program: Any
    ops: Any
    dtype: str = "float64"

    @property
    def scene(self) -> PolicyScene:
        """The scene."""
        return self.program.scene

    @property
    def n_observations(self) -> int:
        """Length of an observation."""
        return int(self.scene.n_observations)

    @property
    def n_actions(self) -> int:
        """Length of an action."""
        return int(self.scene.n_u)

    @property
    def length(self) -> int:
        """Control steps of an episode that is not terminated."""
        return int(self.scene.horizon)

    @property
    def n_start(self) -> int:
        """Number of standard normal numbers that decide a start."""
        return int(self.scene.exogenous)

    @property
    def structure(self) -> tuple[Any, ...]:
        """A key for compiled functions: environments with equal keys differ only in :meth:`parameters`."""
        return type(self.ops), self.dtype, self.program.structure

    def parameters(self) -> Any:
        """Return the float parameters of the program, ``(p,)``."""
        return self.program.parameters().astype(self.dtype)

    def bind(self, parameters: Any) -> Environment:
        """Return the environment with other values of its float parameters, possibly traced."""
        return replace(self, program=self.program.bind(parameters))

    def normal(self, key: Array, shape: tuple[int, ...]) -> Array:
        """Return standard normal numbers in the precision of the environment."""
        return jax.random.normal(key, shape, self.dtype)

    def start(self, numbers: Array) -> Episodes:
        """Return episodes at their starts, from standard normal ``numbers (n_start, B)``."""
        if self.n_start:
            q, v = self.scene.random_start(self.ops.xp, numbers)
        else:
            # the scene has one start, which depends on no theta
            nothing = jnp.zeros((self.scene.theta0().size, numbers.shape[1]), self.dtype)
            q, v = self.scene.initial_state(self.ops.xp, nothing)
        return Episodes(State(q, v), jnp.zeros(numbers.shape[1], dtype=jnp.int32))

    def observe(self, state: State) -> Array:
        """Return the observations, ``(n_observations, B)``."""
        return self.scene.observation(self.ops.xp, state.q, state.v)

    def step(self, episodes: Episodes, action: Array, numbers: Array) -> Transition:
        """Return the transitions under ``action (n_u, B)``; ``numbers (n_start, B)`` give the starts after resets."""
        scene, xp, before = self.scene, self.ops.xp, episodes.state
        controls = scene.controls_of(xp, action)
        reward = -scene.stage_cost(xp, before.q, before.v, controls)
        reached = State(*self.program.step(self.ops, before, controls))
        age = episodes.age + 1
        finite = jnp.isfinite(jnp.concatenate(reached)).all(axis=0)
        over = scene.has_ended(xp, reached.q, reached.v)
        terminated = ~finite if over is None else over | ~finite
        ended = terminated | (age >= self.length)
        # the last step of an episode also pays the scene's terminal cost, 0 in most scenes
        reward = reward - jnp.where(ended, scene.terminal_cost(xp, reached.q, reached.v), 0.0)
        fresh = jax.lax.stop_gradient(self.start(numbers).state)
        state = State(*(jnp.where(ended, new, old) for new, old in zip(fresh, reached, strict=True)))
        return Transition(Episodes(state, jnp.where(ended, 0, age)), reached, reward, ended, terminated)

    def returns(self, policy: Callable[[Array], Array], numbers: Array) -> Array:
        """Return the undiscounted returns ``(B,)`` of episodes from starts ``numbers (n_start, B)`` to their first end.

        ``policy`` gives actions ``(n_u, B)`` from observations ``(n_observations, B)``.
        """

        def step(carry: tuple[Episodes, Array, Array], _: Any) -> tuple[tuple[Episodes, Array, Array], None]:
            episodes, total, over = carry
            moved = self.step(episodes, policy(self.observe(episodes.state)), numbers)
            total = total + jnp.where(over, 0.0, moved.reward)
            return (moved.next, total, over | moved.ended), None

        first = self.start(numbers)
        carry = (first, jnp.zeros(numbers.shape[1], numbers.dtype), jnp.zeros(numbers.shape[1], dtype=bool))
        (_, total, _), _ = jax.lax.scan(step, carry, None, length=self.length)
        return total

    def contacts(self, state: State) -> tuple[Array, Array, Array]:
        """Return, per rollout ``(B,)``, closed contacts, largest penetration [m] and largest contact force [N].

        The force is NaN for a law without forces. Without contacts all are 0. The program of an engine says which contacts
        it has by ``contacts(state)``.
        """
        if hasattr(self.program, "contacts"):
            return self.program.contacts(jax.lax.stop_gradient(state))

        scene, law, xp = self.scene, self.program.contact, self.ops.xp
        zero = jnp.zeros_like(state.q[0])
        if not (isinstance(scene, ContactScene) and scene.n_contacts):
            return zero, zero, zero
        gap = scene.gap(xp, state.q)
        force = zero + jnp.nan
        if isinstance(law, ForceLaw):
            force = law.force(xp, gap, scene.gap_rate(xp, state.q, state.v)).max(axis=0)
        return (gap < 0).sum(axis=0).astype(zero.dtype), jnp.maximum(-gap, 0.0).max(axis=0), force
