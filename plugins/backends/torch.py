"""PyTorch: autograd through the same rollout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bench.model import Array, Backend, LoopOps, Problem, Program, Trajectory, rollout


@dataclass(frozen=True)
class Torch(Backend):
    """Gradients: reverse-mode autograd of the program on the CPU; float64 or float32; no implicit equations."""

    name = "torch"
    requires = ("torch",)
    provides = Backend.provides | {"surrogate"}
    reference_rank = 2

    def compile(self, program: Program) -> Problem:
        return TorchProblem(program, self.dtype)


class TorchOps(LoopOps):
    """Operations of torch through array-api-compat with a Python loop and without ``root``."""

    def __init__(self) -> None:
        import array_api_compat.torch

        super().__init__(array_api_compat.torch)


class TorchProblem(Problem):
    """A program run by torch."""

    block = 1 << 14

    def __init__(self, program: Program, dtype: str) -> None:
        import torch

        super().__init__(program)
        self._torch, self._ops = torch, TorchOps()
        self._dtype = getattr(torch, dtype)

    def _tensor(self, array: np.ndarray) -> Array:
        return self._torch.tensor(np.ascontiguousarray(array), dtype=self._dtype)

    def _value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        with self._torch.no_grad():
            cost = self.program.cost(self._ops, self._tensor(theta), self._tensor(w))
        return np.asarray(cost.to(self._torch.float64).numpy())

    def trajectory(self, theta: np.ndarray, w: np.ndarray) -> Trajectory:
        theta = np.reshape(theta, (self.dim, -1))
        with self._torch.no_grad():
            parts = rollout(self.program).path(self._ops, self._tensor(theta), self._tensor(w))
        return Trajectory(*(part.to(self._torch.float64).numpy() for part in parts))

    def _grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return self._derivative(lambda full, w: self.program.cost(self._ops, full, w), theta, w)

    def _score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        fixed = self._tensor(theta)
        return self._derivative(lambda full, w: self.program.log_probability(self._ops, fixed, full, w), theta, w)

    def _derivative(self, function: Callable[[Array, Array], Array], theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return the derivative of column b of ``function`` by column b of theta, ``(d, B)``; 0 if it is independent.

        The derivative is set to NaN if the value of column b is not finite: torch.where between NaN and a number would
        have the number's derivative.
        """
        full = self._tensor(np.broadcast_to(theta, (self.dim, w.shape[1]))).requires_grad_()
        result = function(full, self._tensor(w))
        invalid = ~self._torch.isfinite(result.detach())
        if not result.requires_grad:
            gradient = self._torch.zeros_like(full)
        else:
            (gradient,) = self._torch.autograd.grad(result.sum(), full, allow_unused=True, materialize_grads=True)
        return gradient.masked_fill(invalid, float("nan")).detach().to(self._torch.float64).numpy()
