"""Fused: a rollout and its adjoint as one native loop, compiled by Numba."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, Backend, Problem, Program

from .. import fused
from ..fused import emit, kernels, trace
from ..fused.graph import Refused
from .jax import Jax, JaxOps, JaxProblem, loop, use_double_precision


@dataclass(frozen=True)
class Fused(Backend):
    """Gradients: exact derivative of the program by JAX's rules for single operations; float64 or float32; no roots.

    JAX traces the program once for one rollout. The step and its adjoint become scalar code with an inner time loop,
    and rollouts are the lanes of vector instructions, so that states remain in registers and cache. Results equal the
    results of ``jax`` up to rounding, also at ties. Trajectories and step Jacobians are computed by ``jax``. Programs
    with an operation that has no scalar form are not supported.
    """

    name = "fused"
    uses = (fused,)
    requires = ("jax", "numba")
    # surrogate gradients are not supported
    provides = Jax.provides - {"surrogate"}

    def compile(self, program: Program) -> Problem:
        use_double_precision()
        return FusedProblem(program, JaxOps(), self.dtype, "reverse")

    def own_refusal(self, program: Program) -> str | None:
        """Return why the program cannot run, for example an operation without scalar form, or None."""
        if program.needs - self.provides:
            return None
        if program.surrogate:
            return f"backend {self.name} differentiates the program itself, not a law's surrogate: use jax"
        use_double_precision()
        try:
            for function in ("value", "grad"):
                _source(program, function, self.dtype)
        except Refused as error:
            return f"backend {self.name} has no scalar code for {error}"
        return None


class _PlainOps(JaxOps):
    """Operations of jax.numpy with a plain lax.scan."""

    def scan(self, step: Any, carry: Any, xs: Any, length: int) -> Any:
        return loop(step, carry, xs, length, recomputes=False)


@dataclass(frozen=True)
class _Source:
    """The source of a kernel and its tables of constants."""

    text: str
    length: int
    constants: np.ndarray
    indices: np.ndarray


_sources: dict[tuple[Any, ...], _Source] = {}
"""By the program's structure, function and type."""


def _source(program: Program, function: str, dtype: str) -> _Source:
    key = (program.structure, function, dtype)
    if key not in _sources:
        _sources[key] = _traced(program, function, dtype)
    return _sources[key]


def _traced(program: Program, function: str, dtype: str) -> _Source:

    def cost(parameter: Array, theta: Array, noise: Array) -> Array:
        return program.bind(parameter).cost(_PlainOps(), theta, noise)

    def log_probability(parameter: Array, theta: Array, noise: Array, scored: Array) -> Array:
        return program.bind(parameter).log_probability(_PlainOps(), theta, scored, noise)

    shapes = {"parameter": len(program.parameters()), "theta": program.dim, "noise": program.n_noise}
    wrt = {"value": None, "grad": "theta", "score": "scored"}[function]
    scored = {"scored": program.dim}
    rollout = trace.traced(log_probability, shapes | scored) if wrt == "scored" else trace.traced(cost, shapes)
    text = emit.source(rollout, dtype, wrt, program.dim, f"{function} of {program.scene.name}")
    flat = [np.concatenate(part) if part else np.zeros(1) for part in (rollout.constants, rollout.indices)]
    return _Source(text, rollout.length, flat[0].astype(dtype), flat[1].astype(np.int64))


class FusedProblem(JaxProblem):
    """A program as compiled kernels for any batch and horizon; float parameters are arguments."""

    grain = emit.LANES
    # a thread with fewer columns takes less time than starting it
    least = 4096

    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return np.asarray(self._kernel("value", theta, w, 1)[0][0])

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        gradient, is_bounded = self._kernel("grad", theta, w, self.dim)
        # a cost that overflows has no gradient, even if its slope is finite
        return gradient if is_bounded else np.where(np.isfinite(self._value(theta, w)), gradient, np.nan)

    def _score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return self._kernel("score", theta, w, self.dim)[0]

    def _kernel(self, function: str, theta: np.ndarray, w: np.ndarray, rows: int) -> tuple[np.ndarray, bool]:
        """Return a kernel's result ``(rows, B)``, and whether all derivatives are so small that all costs are finite."""
        batch = w.shape[1]
        if not batch:
            return np.empty((rows, 0)), True
        source = _source(self.program, function, self._dtype.name)
        is_shared = theta.shape[1] == 1
        # contiguous, since the rows of a large batch are so far apart that each needs its own memory page
        theta = np.ascontiguousarray(np.repeat(theta, self.grain, axis=1) if is_shared else theta, self._dtype)
        w = np.ascontiguousarray(w, self._dtype)
        column = (theta.reshape(-1), theta.shape[1], int(not is_shared))
        out = np.empty((rows, batch), self._dtype)
        arguments = (
            self._parameters,
            source.constants,
            source.indices,
            source.length,
            *column,
            *column,
            w.reshape(-1),
            batch,
            out.reshape(-1),
            batch,
            rows,
            0,
            batch,
        )
        is_small, is_bounded = self._compiled(source.text)(*arguments)
        if not is_small:
            _, is_bounded = self._compiled(kernels.exact(source.text))(*arguments)
        return out.astype(np.float64, copy=False), is_bounded

    def _compiled(self, text: str) -> Any:
        kernel = kernels.compiled(text, self._dtype.name, self._measured, self.compilations)
        self._charge(kernel.name, kernel.seconds)
        return kernel.call
