"""Differentiates MJX through its converged constraint solver, by the implicit-function theorem."""

from __future__ import annotations

import contextlib
import io
import threading
from collections.abc import Iterator
from typing import Any

REVISION = 1
"""Raised when a stored number that this module decides moves."""

_tracing = threading.RLock()


@contextlib.contextmanager
def implicit() -> Iterator[None]:
    """Let ``mjx.step`` and ``mjx.forward`` that are traced inside use :func:`solve` as their constraint solver.

    They are then differentiable in reverse and forward mode for any number of solver iterations.
    """
    from mujoco.mjx._src import solver

    with _tracing:
        solver.solve = solve
        try:
            yield
        finally:
            solver.solve = library().solve


def solve(model: Any, data: Any) -> Any:
    """Return the data with accelerations and constraint forces of ``mjx.solve``, with the converged solution's derivative.

    The solver minimises a convex cost of the accelerations a, so that the cost's gradient g is 0 at its solution. MJX's
    solver runs on constants: the warm start, too, has no derivative. From its result, Newton steps a - H^-1 g(a) with
    the Hessian H follow. At the minimum they change nothing, and the last one has the derivative -H^-1 dg of the
    implicit-function theorem. Where the solver has not converged, it has not; see :func:`relative_residual`.
    """
    import jax

    constants = jax.lax.stop_gradient((model, data))
    acceleration = library().solve(*constants).qacc
    # two Newton steps after the solver. The last one is differentiated; the first ensures that it starts at the minimum
    for at in (constants, (model, data)):
        start = jax.lax.stop_gradient(acceleration)
        hessian = jax.jacfwd(lambda a: _cost_gradient(*constants, a))(start)
        newton = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(hessian), _cost_gradient(*at, start))
        acceleration = start - newton
    context = _context(model, data, acceleration)
    return data.tree_replace(
        {
            "qacc": acceleration,
            "qfrc_constraint": context.qfrc_constraint,
            "_impl.efc_force": context.efc_force,
        }
    )


def relative_residual(model: Any, data: Any) -> Any:
    """Return |M a - f| / (|f_smooth| + |f_constraint|) of data after a forward pass, with f the sum of both forces.

    It is 0 for the exact solution of the constraint solver.
    """
    import jax.numpy as jnp

    smooth, constraint = data.qfrc_smooth, data.qfrc_constraint
    size = jnp.linalg.norm(smooth) + jnp.linalg.norm(constraint)
    residual = jnp.linalg.norm(library().mul_m(model, data, data.qacc) - smooth - constraint)
    return residual / jnp.maximum(size, jnp.finfo(size.dtype).tiny)


def library() -> Any:
    """Return ``mujoco.mjx`` without printing its messages about missing optional parts."""
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def _context(model: Any, data: Any, acceleration: Any) -> Any:
    """Return MJX's constraint forces at an acceleration ``(nv,)``."""
    from mujoco.mjx._src.solver import Context

    return Context.create(model, data.replace(qacc=acceleration), grad=False)


def _cost_gradient(model: Any, data: Any, acceleration: Any) -> Any:
    """Return the gradient of the solver's cost by the acceleration: M a - f_smooth - J^T f(J a - a_ref), ``(nv,)``."""
    context = _context(model, data, acceleration)
    return context.Ma - data.qfrc_smooth - context.qfrc_constraint
