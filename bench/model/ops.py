"""Arrays, the operations that a backend provides to model code, and the state of a mechanical system."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from bench.errors import Unsupported

Array = Any
"""An array of the backend's library: NumPy, torch or JAX."""


class LoopOps:
    """The operations that a backend provides to model code: here a Python loop, and no root finder.

    ``xp`` is an array namespace following the Python array API standard: numpy, torch via array-api-compat, jax.numpy.
    """

    def __init__(self, xp: Any = np) -> None:
        self.xp = xp

    def scan(self, step: Callable[[Any, Any], Any], carry: Any, xs: Any, length: int) -> Any:
        """Return the last carry of ``carry = step(carry, x)`` over the leading axis of the leaves of ``xs``."""
        for _, *slices in zip(range(length), *xs, strict=True):
            carry = step(carry, tuple(slices))
        return carry

    def root(self, residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
        """Return ``z (n, B)`` with ``residual(z, args) = 0``, whose column b must depend on column b of z only.

        The derivative is computed by the implicit-function theorem. Raises :class:`Unsupported` on backends without
        ``root``.
        """
        raise Unsupported(
            "a step solves an equation, and this backend has no root finder: use a backend that provides root (see `python -m bench list backends`)"
        )


Ops = LoopOps
"""The type of the operations of any backend, with or without ``root``."""


def stopped(array: Array) -> Array:
    """Return the array as a constant for automatic differentiation; NumPy arrays are returned unchanged."""
    if hasattr(array, "detach"):
        return array.detach()
    if type(array).__module__.partition(".")[0] in ("jax", "jaxlib"):
        import jax

        return jax.lax.stop_gradient(array)
    return array


class State(NamedTuple):
    """Generalised positions ``q (n_q, B)`` and velocities ``v (n_v, B)``."""

    q: Array
    v: Array
