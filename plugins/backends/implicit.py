"""Implicit steps: equations solved in each step and differentiated by the implicit-function theorem."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from bench.model import Array, Ops

from .jax import Jax, JaxOps, use_double_precision


@dataclass(frozen=True)
class Implicit(Jax):
    """Gradients: reverse mode through the rollout, implicit-function theorem at each solve, never through the solver.

    optimistix computes the root by Newton's method and lineax solves the linear systems. Programs without an equation
    run as on ``jax``. Float64 or float32. Forward mode is also available, although it is not the solver's adjoint.
    """

    name = "implicit"
    requires = ("jax", "optimistix", "lineax")
    provides = Jax.provides | {"root"}
    reference_rank = 1

    def ops(self) -> Ops:
        """Return JAX operations with a root finder.

        Equinox, on which optimistix and lineax are built, is configured to return the nonfinite result of a failed
        solve in its own column. Its other options, an exception or NaN, would affect the whole batch. A program that
        has imported Equinox before must set ``EQX_ON_ERROR=off`` itself, or a failed column raises an error for its
        batch.
        """
        os.environ.setdefault("EQX_ON_ERROR", "off")
        use_double_precision()
        return ImplicitOps()


class ImplicitOps(JaxOps):
    """JAX operations, and ``root`` through optimistix."""

    def root(self, residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
        """Return the root by Newton's method, ``(n, B)``. A failure in one column does not affect other columns.

        A column has converged if the residual is below 1e-12 (1e-6 in float32) and the unknown changes by less than the
        same absolute and relative tolerance, or if the residual is at the rounding error of the unknown, since stiff
        equations do not reach 1e-12. Columns that do not converge in 64 iterations have NaN values and gradients, so
        that their rollouts are ``nonfinite`` instead of wrong.
        """
        import jax
        import jax.numpy as jnp
        import lineax
        import optimistix

        tolerance = 1e-12 if guess.dtype == jnp.float64 else 1e-6
        scalar = guess.shape[0] == 1
        # one unknown per column needs a division instead of a factorisation
        linear: Any = lineax.Diagonal(well_posed=True) if scalar else lineax.LU()
        newton: Any = _newton()(rtol=tolerance, atol=tolerance, linear_solver=linear)

        def column(start: Array, args: Any) -> Array:
            def function(z: Array, args: Any) -> Array:
                widened = jax.tree.map(lambda a: a[..., None] if jnp.ndim(a) else a, args)
                return residual(z[:, None], widened)[:, 0]

            solution: Any = optimistix.root_find(
                function,
                newton,
                start,
                args,
                max_steps=64,
                throw=False,
                adjoint=optimistix.ImplicitAdjoint(linear),
                tags=frozenset({lineax.diagonal_tag} if scalar else ()),
            )
            solved = solution.result == optimistix.RESULTS.successful
            # a factor, since jnp.where(solved, value, NaN) would have the gradient of the value
            return solution.value * jnp.where(solved, 1.0, jnp.nan).astype(guess.dtype)

        axes = jax.tree.map(lambda a: -1 if jnp.ndim(a) else None, args)
        # the root does not depend on the initial guess
        return jax.vmap(column, in_axes=(-1, axes), out_axes=-1)(jax.lax.stop_gradient(guess), args)


@cache
def _newton() -> Any:
    """Return optimistix's Newton class with a termination test that does not depend on the residual's units."""
    import equinox
    import jax.numpy as jnp
    import optimistix

    class Newton(optimistix.Newton):  # type: ignore[type-arg]
        """Newton's method that also terminates when the residual is at the rounding error of the unknown.

        A residual that multiplies a gap by dt^2 k / m = 1e11 has rounding errors of 1e-5 at the root, and Newton's
        method may alternate between two adjacent numbers with and without contact. The steepest slope so far is stored
        in ``diffsize_prev``, a field of the state that is otherwise unused.
        """

        def step(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> Any:
            """Return the results of a Newton step, with the steepest slope stored in the state."""
            after, new_state, aux = super().step(fn, y, args, options, state, tags)
            slope = jnp.abs(new_state.f).max() / jnp.maximum(jnp.abs(new_state.diff).max(), jnp.finfo(y.dtype).tiny)
            steepest = jnp.maximum(state.diffsize_prev, jnp.where(jnp.isfinite(slope), slope, 0.0))
            return after, equinox.tree_at(lambda s: s.diffsize_prev, new_state, steepest.astype(y.dtype)), aux

        def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> Any:
            """Return whether to terminate, and the result code."""
            done, result = super().terminate(fn, y, args, options, state, tags)
            return done | self._is_rounding(y, state), result

        def postprocess(
            self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: Any, tags: Any, result: Any
        ) -> Any:
            """Return the unknown before the last step if its residual was rounding error, else the unknown after it."""
            return jnp.where(self._is_rounding(y, state), y + state.diff, y), aux, {}

        def _is_rounding(self, y: Any, state: Any) -> Any:
            # units in the last place of the unknown below which a residual counts as rounding error
            allowed = 8.0 * jnp.finfo(y.dtype).eps * (1.0 + jnp.abs(y).max()) * state.diffsize_prev
            # iterations before a residual may count as rounding error. Newton's method needs fewer if it
            # converges
            return (state.step >= 8) & jnp.isfinite(state.f).all() & (jnp.abs(state.f).max() <= allowed)

    return Newton
