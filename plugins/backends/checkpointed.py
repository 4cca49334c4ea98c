"""JAX with a choice of what the backward pass keeps: everything, step Jacobians, or states at checkpoints."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Ops, Problem, Program, Rollout, adjoint, adjoint_gradient, param, slopes

from .jax import Jax, JaxOps, JaxProblem, loop, use_double_precision


@dataclass(frozen=True)
class Checkpointed(Jax):
    """Gradients as ``jax`` computes them, in less memory or in less time; float64 or float32; no root finder.

    ``keep=everything`` keeps the results of all operations, as plain reverse mode through lax.scan does.
    ``keep=jacobians`` keeps the states and their step Jacobians and multiplies adjoints by these. ``keep=states`` keeps
    states and computes the steps between them again. With ``levels=1`` these are the states of all T steps, as on
    ``jax``. With L levels the steps are cut into about T^(1/L) pieces, each piece into as many, and so on: about
    L T^(1/L) states are kept at a time, and each step is computed L + 1 times (Griewank and Walther 2000 minimise the
    number of computed steps for a given number of states, at the same order of growth).
    """

    name = "checkpointed"
    uses = (adjoint,)
    reference_rank = None

    keep: str = param("states", "what the backward pass keeps", choices=("states", "everything", "jacobians"))
    levels: int = param(2, "levels of checkpoints, for keep=states", positive=True)

    def compile(self, program: Program) -> Problem:
        return _CheckpointedProblem(program, self)

    def ops(self) -> Ops:
        use_double_precision()
        return _CheckpointedOps(self.levels if self.keep == "states" else 0)

    def own_refusal(self, program: Program) -> str | None:
        if self.keep != "jacobians":
            return None
        if not isinstance(program, Rollout):
            return f"{self.name}[keep=jacobians] needs time steps, and scene {program.scene.name} is a plain function"
        if program.decision.names:
            return f"{self.name}[keep=jacobians] differentiates by the scene's own theta, not by {list(program.decision.names)}"
        return None


class _CheckpointedOps(JaxOps):
    """Operations of jax.numpy whose loops have some levels of checkpoints; with 0 levels everything is kept."""

    def __init__(self, levels: int) -> None:
        super().__init__()
        self._levels = levels

    def loop(self, body: Callable[[Any, Any], Any], carry: Any, xs: Any, length: int) -> Any:
        return _nested(body, carry, xs, length, self._levels)


def _nested(body: Callable[[Any, Any], Any], carry: Any, xs: Any, length: int, levels: int) -> Any:
    """Return the last carry of ``body`` over ``length`` steps, whose backward pass keeps states at some levels."""
    import jax

    if levels <= 1:
        return loop(body, carry, xs, length, recomputes=levels == 1)
    size = math.ceil(length ** (1 - 1 / levels))
    count = length // size
    whole = jax.tree.map(lambda x: x[: count * size].reshape(count, size, *x.shape[1:]), xs)
    carry = loop(lambda state, x: _nested(body, state, x, size, levels - 1), carry, whole, count)
    rest = length - count * size
    return _nested(body, carry, jax.tree.map(lambda x: x[count * size :], xs), rest, levels - 1) if rest else carry


class _CheckpointedProblem(JaxProblem):
    """A program of ``jax`` with executables of its own, whose gradient may come from step Jacobians."""

    def __init__(self, program: Program, backend: Checkpointed) -> None:
        super().__init__(program, backend.ops(), backend.dtype, backend.mode)
        self.variant = (backend.keep, backend.levels)

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        if self.variant[0] != "jacobians":
            return super()._grad(theta, w)
        shared = theta[:, 0] if theta.shape[1] == 1 else theta
        return np.asarray(adjoint_gradient(self, slopes(self, shared, w)))
