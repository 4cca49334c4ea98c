"""Compiles a trainer on an environment, once for all seeds and parameter values."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from bench.model.trainer import Trainer
from bench.training import agreement
from bench.training.environment import Environment

_compiled: dict[tuple[Any, ...], tuple[Callable[..., Any], float]] = {}
"""Executables and the seconds of their compilation, by environment structure, trainer, function and shapes."""


class Training:
    """A trainer on an environment: compiled functions that start, update and evaluate runs."""

    def __init__(self, env: Environment, trainer: Trainer) -> None:
        self.env, self.trainer = env, trainer
        self.compile_s = 0.0
        """Seconds of the compilations that this object uses, also if another one has made them."""
        self._used: set[tuple[Any, ...]] = set()

    def start(self, seed: int) -> Any:
        """Return the state before the first update."""
        return self._call("start", lambda env, seed: self.trainer.start(env, seed), np.uint32(seed))

    def update(self, state: Any) -> tuple[Any, dict[str, Any]]:
        """Return the state after one update and its log. The arrays of ``state`` are used up."""
        return self._call("update", self.trainer.update, state)

    def compile_update(self, state: Any) -> None:
        """Compile the update without running it, so that its time is not part of the first update's."""
        self._executable("update", self.trainer.update, (state,))

    def returns(self, state: Any, numbers: np.ndarray) -> np.ndarray:
        """Return the returns ``(B,)`` of the deterministic policy from starts ``numbers (n_start, B)``."""

        def evaluate(env: Environment, state: Any, numbers: Any) -> Any:
            return env.returns(lambda seen: self.trainer.action(env, state, seen), numbers)

        numbers = np.asarray(numbers, dtype=self.env.dtype)
        return np.asarray(self._call("returns", evaluate, state, numbers), dtype=np.float64)

    def agreement(self, state: Any, seed: int, copies: int) -> dict[str, float]:
        """Return the cosines of :func:`agreement.cosine` at a first-order trainer's state, from ``copies`` per rollout."""

        def compare(env: Environment, state: Any, seed: Any) -> Any:
            parts = partial(self.trainer.parts, env, state)
            return agreement.cosine(parts, state.actor, jax.random.PRNGKey(seed), copies)

        cosines = self._call(f"agreement {copies}", compare, state, np.uint32(seed))
        return {name: float(value) for name, value in cosines.items()}

    def gradient(self, state: Any, seed: int, window: int, every: int = 0) -> np.ndarray:
        """Return the derivative of the mean return of rollouts from new starts by the actor's parameters, ``(d,)``.

        For trainers with windows: of ``window`` control steps. A positive ``every`` cuts them into windows of that length, each
        of which ends in the critic's value. The noise is the same for each ``every``.
        """
        trainer: Any = dataclasses.replace(self.trainer, window=window)  # type: ignore[call-arg]

        def differentiate(env: Environment, state: Any, seed: Any) -> Any:
            def mean_return(actor: Any) -> Any:
                key_start, key = jax.random.split(jax.random.PRNGKey(seed))
                fresh = trainer.fresh(env, state, key_start)
                return trainer.parts(env, fresh, actor, key, every=every)[0].sum(axis=0).mean()

            return ravel_pytree(jax.grad(mean_return)(state.actor))[0]

        return np.asarray(
            self._call(f"gradient {window} {every}", differentiate, state, np.uint32(seed)), dtype=np.float64
        )

    def loss(self, state: Any, shift: np.ndarray) -> float:
        """Return the loss that the next update logs, at the actor's parameters plus ``shift (d,)``."""

        def evaluate(env: Environment, state: Any, shift: Any) -> Any:
            theta, unflatten = ravel_pytree(state.actor)
            return self.trainer.update(env, state._replace(actor=unflatten(theta + shift)))[1]["loss"]

        return float(self._call("loss", evaluate, state, np.asarray(shift, self.env.dtype)))

    def applied(self, state: Any) -> np.ndarray:
        """Return the gradient along which the next update moves the actor, ``(d,)``, of length 1.

        Adam's mean is set to 0 and its mean square to a large constant, so that its step has the gradient's direction.
        """

        def move(env: Environment, state: Any) -> Any:
            means = jax.tree.map(jnp.zeros_like, optax.tree.get(state.memory, "mu"))
            # mean square far above that of gradients, whose norm trainers clip at about 1
            squares = jax.tree.map(lambda x: x + 1e8, means)
            memory = optax.tree.set(state.memory, mu=means, nu=squares)
            after, _ = self.trainer.update(env, state._replace(memory=memory))
            change = ravel_pytree(state.actor)[0] - ravel_pytree(after.actor)[0]
            return change / jnp.linalg.norm(change)

        return np.asarray(self._call("applied", move, state), dtype=np.float64)

    def _call(self, name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        return self._executable(name, function, arguments)(self.env.parameters(), *arguments)

    def _executable(self, name: str, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Callable[..., Any]:
        shapes = tuple((np.shape(x), str(x.dtype)) for x in jax.tree.leaves(arguments))
        key = (self.env.structure, self.trainer, name, shapes)
        if key not in _compiled:
            env = self.env
            donated = (1,) if name == "update" else ()
            # one thread per program: the matrices are too small to share
            options: Any = {"xla_cpu_multi_thread_eigen": False} if jax.default_backend() == "cpu" else None
            started = time.perf_counter()
            jitted = jax.jit(lambda p, *given: function(env.bind(p), *given), donate_argnums=donated)
            call = jitted.lower(self.env.parameters(), *arguments).compile(options)
            _compiled[key] = (call, time.perf_counter() - started)
        executable, seconds = _compiled[key]
        if key not in self._used:
            self._used.add(key)
            self.compile_s += seconds
        return executable
