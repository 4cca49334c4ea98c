"""Compiles a trainer on an environment, once for all seeds and parameter values."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.model.trainer import Trainer
from bench.training import evaluation
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
        return self._call("update", self.trainer.update, state)  # type: ignore[no-any-return]

    def returns(self, state: Any, numbers: np.ndarray) -> np.ndarray:
        """Return the returns ``(B,)`` of the deterministic policy from starts ``numbers (n_start, B)``."""

        def evaluate(env: Environment, state: Any, numbers: Any) -> Any:
            return evaluation.returns(env, lambda seen: self.trainer.action(env, state, seen), numbers)

        numbers = np.asarray(numbers, dtype=self.env.dtype)
        return np.asarray(self._call("returns", evaluate, state, numbers), dtype=np.float64)

    def _call(self, name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        import jax

        parameters = self.env.parameters()
        shapes = tuple((np.shape(x), str(x.dtype)) for x in jax.tree.leaves(arguments))
        key = (self.env.structure, self.trainer, name, shapes)
        if key not in _compiled:
            env = self.env
            donated = (1,) if name == "update" else ()
            options: Any = {"xla_cpu_multi_thread_eigen": False} if jax.default_backend() == "cpu" else None
            started = time.perf_counter()
            jitted = jax.jit(lambda p, *given: function(env.bind(p), *given), donate_argnums=donated)
            call = jitted.lower(parameters, *arguments).compile(options)
            _compiled[key] = (call, time.perf_counter() - started)
        call, seconds = _compiled[key]
        if key not in self._used:
            self._used.add(key)
            self.compile_s += seconds
        return call(parameters, *arguments)
