"""Implicit contact: equations solved each step, differentiated by the implicit-function theorem."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

from bench.contracts import Array, Backend, Ops
from plugins.backends.jax import Jax, JaxOps


@dataclass(frozen=True)
class Implicit(Jax):
    """Gradients: reverse mode through the rollout, the implicit-function theorem at each solve; never through the solver.

    optimistix finds the root (Newton), lineax solves the linear systems. Programs without an equation to solve run
    as on ``jax``. Float64 or float32; forward mode is not the solver's adjoint and is available all the same.
    """

    name = "implicit"
    requires: ClassVar[tuple[str, ...]] = ("jax", "optimistix", "lineax")
    provides = Backend.provides | {"root"}
    reference_rank: ClassVar[int | None] = 1

    def ops(self) -> Ops:
        """JAX operations with a root finder.

        Equinox, under optimistix and lineax, is asked for NaN instead of an exception where a solve in the adjoint fails,
        so that it ends one rollout and not the batch.
        """
        os.environ.setdefault("EQX_ON_ERROR", "nan")
        import jax

        jax.config.update("jax_enable_x64", True)
        return ImplicitOps()


class ImplicitOps(JaxOps):
    """JAX operations, and ``root`` through optimistix."""

    def root(self, residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
        """Newton's method, all columns at once: one unknown a column is a diagonal system, more are solved by column.

        Residuals are met to a relative and absolute 1e-12 in the unknown (1e-6 in float32). Columns that do not
        converge in 64 iterations come back as NaN, which makes their rollouts ``nonfinite`` instead of wrong.
        """
        import jax
        import jax.numpy as jnp
        import lineax
        import optimistix

        tolerance = 1e-12 if guess.dtype == jnp.float64 else 1e-6
        guess = jax.lax.stop_gradient(guess)

        def solve(function: Callable[..., Array], start: Array, args: Any, diagonal: bool) -> Array:
            linear = lineax.Diagonal() if diagonal else lineax.LU()
            tags = frozenset({lineax.diagonal_tag}) if diagonal else frozenset()
            solution: Any = optimistix.root_find(
                function, optimistix.Newton(rtol=tolerance, atol=tolerance, linear_solver=linear), start, args,
                max_steps=64, throw=False, tags=tags,
            )  # fmt: skip
            return jnp.where(solution.result == optimistix.RESULTS.successful, solution.value, jnp.nan)

        if guess.shape[0] == 1:
            return solve(residual, guess, args, diagonal=True)

        def column(start: Array, args: Any) -> Array:
            def function(z: Array, args: Any) -> Array:
                widened = jax.tree.map(lambda a: a[..., None] if jnp.ndim(a) else a, args)
                return residual(z[:, None], widened)[:, 0]

            return solve(function, start, args, diagonal=False)

        axes = jax.tree.map(lambda a: -1 if jnp.ndim(a) else None, args)
        return jax.vmap(column, in_axes=(-1, axes), out_axes=-1)(guess, args)
