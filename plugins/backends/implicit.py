"""Implicit contact: equations solved each step, differentiated by the implicit-function theorem."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

from bench.model import Array, Ops

from .jax import Jax, JaxOps

ROUNDED = 8.0
"""Units in the last place of the unknown within which a residual is rounding."""
PATIENCE = 8
"""Iterations before rounding is taken for an answer: Newton's method ends within fewer wherever it can."""


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
        finite in its own column: its other choices, an exception or NaN, would spoil the whole batch. A program that
        imports Equinox before sets ``EQX_ON_ERROR=off`` itself, or a column that cannot be solved is an error of its batch.
        """
        os.environ.setdefault("EQX_ON_ERROR", "off")
        import jax

        jax.config.update("jax_enable_x64", True)
        return ImplicitOps()


class ImplicitOps(JaxOps):
    """JAX operations, and ``root`` through optimistix."""

    def root(self, residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
        """Solve by Newton's method, each column on its own: a failed one spoils no values or gradients of the others.

        Residuals are met to 1e-12 (1e-6 in float32), and the unknown to that plus as much of its own size; or the
        residual is down to the rounding of the unknown, as no residual of a stiff equation gets as small as 1e-12.
        Columns that do not converge in 64 iterations come back as NaN, values and gradients, which makes their rollouts
        ``nonfinite`` instead of wrong.
        """
        import jax
        import jax.numpy as jnp
        import lineax
        import optimistix

        tolerance = 1e-12 if guess.dtype == jnp.float64 else 1e-6
        scalar = guess.shape[0] == 1
        # one unknown per column: a division instead of a factorisation
        linear: Any = lineax.Diagonal(well_posed=True) if scalar else lineax.LU()
        newton: Any = _newton()(rtol=tolerance, atol=tolerance, linear_solver=linear)

        def column(start: Array, args: Any) -> Array:
            def function(z: Array, args: Any) -> Array:
                widened = jax.tree.map(lambda a: a[..., None] if jnp.ndim(a) else a, args)
                return residual(z[:, None], widened)[:, 0]

            solution: Any = optimistix.root_find(
                function, newton, start, args, max_steps=64, throw=False,
                adjoint=optimistix.ImplicitAdjoint(linear),
                tags=frozenset({lineax.diagonal_tag} if scalar else ()),
            )  # fmt: skip
            solved = solution.result == optimistix.RESULTS.successful
            # a factor, since a choice between value and NaN would give the gradient of the value
            return solution.value * jnp.where(solved, 1.0, jnp.nan).astype(guess.dtype)

        axes = jax.tree.map(lambda a: -1 if jnp.ndim(a) else None, args)
        # the root does not depend on where the search for it starts
        return jax.vmap(column, in_axes=(-1, axes), out_axes=-1)(jax.lax.stop_gradient(guess), args)


@cache
def _newton() -> Any:
    """Return optimistix's Newton with an end that does not depend on the units of the residual."""
    import equinox
    import jax.numpy as jnp
    import optimistix

    class Newton(optimistix.Newton):  # type: ignore[type-arg,misc]
        """Newton's method that also ends where the residual is what rounding the unknown makes of it.

        A residual that multiplies a gap by dt^2 k / m = 1e11 rounds to 1e-5 at the root itself, and may step to and fro
        between touching and not, which are one number apart. The steepest slope met is kept in a field of the state
        that this end of the iteration leaves unused.
        """

        def step(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> Any:
            """Take a step, and keep the steepest slope."""
            after, found, aux = super().step(fn, y, args, options, state, tags)
            slope = jnp.abs(found.f).max() / jnp.maximum(jnp.abs(found.diff).max(), jnp.finfo(y.dtype).tiny)
            steepest = jnp.maximum(state.diffsize_prev, jnp.where(jnp.isfinite(slope), slope, 0.0))
            return after, equinox.tree_at(lambda s: s.diffsize_prev, found, steepest.astype(y.dtype)), aux

        def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> Any:
            """Return whether to end, and with which result."""
            done, result = super().terminate(fn, y, args, options, state, tags)
            return done | self._rounded(y, state), result

        def postprocess(
            self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: Any, tags: Any, result: Any
        ) -> Any:
            """Return the unknown whose residual was looked at, where that was rounding; else the one after it."""
            return jnp.where(self._rounded(y, state), y + state.diff, y), aux, {}

        def _rounded(self, y: Any, state: Any) -> Any:
            allowed = ROUNDED * jnp.finfo(y.dtype).eps * (1.0 + jnp.abs(y).max()) * state.diffsize_prev
            return (state.step >= PATIENCE) & jnp.isfinite(state.f).all() & (jnp.abs(state.f).max() <= allowed)

    return Newton
