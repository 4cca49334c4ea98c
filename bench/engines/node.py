"""An engine's step as a node of a differentiable program: its result and its vector-Jacobian product."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np


class StepNode(ABC):
    """An engine's step and its vector-Jacobian product, in NumPy; :meth:`torch` and :meth:`jax` make functions of it.

    States x are ``(n, B)``, controls u ``(m, B)``. The carry ``(k, B)`` contains numbers beside x that a step reads and
    writes, such as caches; it is constant in derivatives, and k may be 0. Every backward pass records a tape of its own
    step, so that no tape reads arrays which later steps have overwritten.
    """

    def start(self, x: np.ndarray) -> np.ndarray:
        """Return the carry at states x, ``(k, B)``."""
        return np.empty((0, x.shape[1]))

    @abstractmethod
    def step(self, x: np.ndarray, u: np.ndarray, carry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the states and the carry after one step."""

    @abstractmethod
    def pull(self, x: np.ndarray, u: np.ndarray, carry: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of the sum of ``slope (n, B)`` times the next states by x and by u."""

    def torch(self) -> Callable[[Any, Any, Any], tuple[Any, Any]]:
        """Return a function of tensors (x, u, carry) that returns (x, carry), with derivatives by x and u."""
        import torch

        node = self

        def numpy(tensor: Any) -> np.ndarray:
            return np.asarray(tensor.detach().cpu().numpy(), dtype=np.float64)

        class Step(torch.autograd.Function):
            """A step in torch."""

            @staticmethod
            def forward(context: Any, x: Any, u: Any, carry: Any) -> tuple[Any, Any]:
                """Return the states and the carry after one step."""
                context.save_for_backward(x, u, carry)
                after, carried = node.step(*(numpy(part) for part in (x, u, carry)))
                state, beside = (torch.as_tensor(part, dtype=x.dtype, device=x.device) for part in (after, carried))
                context.mark_non_differentiable(beside)
                return state, beside

            @staticmethod
            def backward(context: Any, slope: Any, _: Any) -> tuple[Any, Any, None]:
                """Return the derivatives by states and controls."""
                x, u, carry = context.saved_tensors
                parts = node.pull(numpy(x), numpy(u), numpy(carry), numpy(slope))
                by_state, by_control = (
                    torch.as_tensor(part, dtype=like.dtype, device=like.device)
                    for part, like in zip(parts, (x, u), strict=True)
                )
                return by_state, by_control, None

        apply: Callable[[Any, Any, Any], tuple[Any, Any]] = Step.apply
        return apply

    def jax(self) -> Callable[[Any, Any, Any], tuple[Any, Any]]:
        """Return a function of JAX arrays (x, u, carry) that returns (x, carry), with reverse-mode derivatives by x and u.

        It can be compiled with ``jax.jit`` and used in ``jax.lax.scan``.
        """
        import jax

        def like(*arrays: Any) -> tuple[Any, ...]:
            return tuple(jax.ShapeDtypeStruct(array.shape, array.dtype) for array in arrays)

        def called(function: Callable[..., Any], results: tuple[Any, ...], *arguments: Any) -> Any:
            def run(*given: Any) -> tuple[np.ndarray, ...]:
                parts = function(*(np.asarray(part, dtype=np.float64) for part in given))
                return tuple(np.asarray(part, dtype=to.dtype) for part, to in zip(parts, results, strict=True))

            return jax.pure_callback(run, results, *arguments)

        @jax.custom_vjp
        def step(x: Any, u: Any, carry: Any) -> Any:
            return called(self.step, like(x, carry), x, u, carry)

        def forward(x: Any, u: Any, carry: Any) -> tuple[Any, Any]:
            return step(x, u, carry), (x, u, carry)

        def backward(saved: Any, slopes: Any) -> tuple[Any, Any, Any]:
            x, u, carry = saved
            return (*called(self.pull, like(x, u), x, u, carry, slopes[0]), jax.numpy.zeros_like(carry))

        step.defvjp(forward, backward)
        return step
