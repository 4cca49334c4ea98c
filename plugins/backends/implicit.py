"""Implicit contact: equations solved each step, differentiated by the implicit-function theorem."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

from bench.model import Array, Ops

from .jax import Jax, JaxOps


@dataclass(frozen=True)
class Implicit(Jax):
    """Gradients: reverse mode through the rollout, implicit-function theorem at each solve, never through the solver.

    optimistix finds the root (Newton), lineax solves the linear systems. Programs without an equation to solve run
    as on ``jax``. Float64 or float32; forward mode is not the solver's adjoint and is available all the same.
    """

    name = "implicit"
    requires: ClassVar[tuple[str, ...]] = ("jax", "optimistix", "lineax")
    provides = Jax.provides | {"root"}
    reference_rank: ClassVar[int | None] = 1

    def ops(self) -> Ops:
        """Return JAX operations with a root finder.

        Equinox, on which optimistix and lineax are built, is set to leave a failed solve in the adjoint as it is, not
        finite in its own column: its other choices, an exception or NaN, would spoil the whole batch.
        """
        os.environ.setdefault("EQX_ON_ERROR", "off")
        import jax

        jax.config.update("jax_enable_x64", True)
        return ImplicitOps()


class ImplicitOps(JaxOps):
    """JAX operations, and ``root`` through optimistix."""

    def root(self, residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
        """Solve by Newton's method, each column on its own: a failed one spoils no values or gradients of the others.

        Residuals are met to a relative and absolute 1e-12 in the unknown (1e-6 in float32). Columns that do not
        converge in 64 iterations come back as NaN, which makes their rollouts ``nonfinite`` instead of wrong.
        """
        import jax
        import jax.numpy as jnp
        import lineax
        import optimistix

        tolerance = 1e-12 if guess.dtype == jnp.float64 else 1e-6
        scalar = guess.shape[0] == 1
        # one unknown per column: a division instead of a factorisation
        linear: Any = lineax.Diagonal(well_posed=True) if scalar else lineax.LU()
        newton: Any = optimistix.Newton(rtol=tolerance, atol=tolerance, linear_solver=linear)

        def column(start: Array, args: Any) -> Array:
            def function(z: Array, args: Any) -> Array:
                widened = jax.tree.map(lambda a: a[..., None] if jnp.ndim(a) else a, args)
                return residual(z[:, None], widened)[:, 0]

            solution: Any = optimistix.root_find(
                function, newton, start, args, max_steps=64, throw=False,
                adjoint=optimistix.ImplicitAdjoint(linear),
                tags=frozenset({lineax.diagonal_tag} if scalar else ()),
            )  # fmt: skip
            return jnp.where(solution.result == optimistix.RESULTS.successful, solution.value, jnp.nan)

        axes = jax.tree.map(lambda a: -1 if jnp.ndim(a) else None, args)
        # the root does not depend on where the search for it starts
        return jax.vmap(column, in_axes=(-1, axes), out_axes=-1)(jax.lax.stop_gradient(guess), args)
