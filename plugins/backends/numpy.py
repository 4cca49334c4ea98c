"""NumPy: costs by running the program, derivatives by batched central differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from bench.model import Array, Backend, LoopOps, Problem, Program, Trajectory, central_differences, param, rollout


@dataclass(frozen=True)
class Numpy(Backend):
    """Gradients: central differences, 2 d rollouts each, error O(step^2); float64 or float32; no implicit equations."""

    name = "numpy"
    reference_rank = 3

    step: float | None = param(
        None, "step of the central differences, in units of theta; null: 1e-6, and 5e-3 in float32", positive=True
    )

    def compile(self, program: Program) -> Problem:
        # about the cube root of the unit roundoff, which balances rounding and truncation errors
        return NumpyProblem(program, self.dtype, self.step or {"float64": 1e-6, "float32": 5e-3}[self.dtype])


def _stack(arrays: Sequence[Array], axis: int = 0) -> Array:
    return np.stack(arrays, axis=axis) if axis else np.array(arrays)


NAMESPACE = SimpleNamespace(**vars(np) | {"stack": _stack})
"""NumPy with a ``stack`` of rows that takes a fifth of the time, since each step stacks rows."""


class NumpyProblem(Problem):
    """A program run by NumPy."""

    block = 1 << 14

    def __init__(self, program: Program, dtype: str, step: float) -> None:
        super().__init__(program)
        self._ops, self._dtype, self.step = LoopOps(NAMESPACE), np.dtype(dtype), step
        self._bound = program.bind([self._dtype.type(p) for p in program.parameters()])

    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            cost = self._bound.cost(self._ops, theta.astype(self._dtype), w.astype(self._dtype))
        return np.asarray(cost, dtype=np.float64)

    def trajectory(self, theta: np.ndarray, w: np.ndarray) -> Trajectory:
        theta = np.reshape(theta, (self.dim, -1)).astype(self._dtype)
        with np.errstate(all="ignore"):
            parts = rollout(self._bound).path(self._ops, theta, w.astype(self._dtype))
        return Trajectory(*(part.astype(np.float64) for part in parts))

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        # usage counts gradients here, not rollouts: the cost of a gradient in rollouts is measured separately
        return central_differences(self._value, theta, w, self.step, self.block)

    def _score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        self.usage.rollouts += 2 * self.dim * w.shape[1]

        def at(moved: np.ndarray, w: np.ndarray) -> np.ndarray:
            fixed = np.tile(theta, (1, moved.shape[1] // theta.shape[1])) if theta.shape[1] > 1 else theta
            with np.errstate(all="ignore"):
                return np.asarray(self._bound.log_probability(self._ops, fixed, moved, w), dtype=np.float64)

        return central_differences(at, theta, w, self.step, self.block)
