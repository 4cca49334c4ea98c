"""Solves the equations of a rollout's steps again, to report residuals and numbers of iterations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bench.measure.contacts import split
from bench.model import Array, Jacobians, LoopOps, Rollout
from bench.trace.states import per_state

TOLERANCE, ITERATIONS = 1e-12, 64
"""Largest last Newton step of a solution, relative to 1 + |z|, and the most Newton steps."""
COLUMNS = ("solver_residual", "solver_iterations", "solver_mismatch")


class Newton(LoopOps):
    """Operations on JAX arrays with a Newton ``root`` that records the residual and the iterations of each column."""

    def __init__(self) -> None:
        import jax.numpy

        super().__init__(jax.numpy)
        self.residuals: list[np.ndarray] = []
        self.iterations: list[np.ndarray] = []

    def root(self, residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
        """Return the root of each column; a column stops once its own Newton step is within tolerance."""
        import jax
        import jax.numpy as jnp

        def derivative(z: Array) -> Array:
            basis = jnp.eye(len(z))[:, :, None] + jnp.zeros_like(z)
            return jax.vmap(lambda e: jax.jvp(lambda y: residual(y, args), (z,), (e,))[1], out_axes=1)(basis)

        z, count, going = guess, np.zeros(guess.shape[1]), np.ones(guess.shape[1], dtype=bool)
        for _ in range(ITERATIONS):
            move = jnp.linalg.solve(jnp.moveaxis(derivative(z), -1, 0), residual(z, args).T[:, :, None])[:, :, 0].T
            z = jnp.where(going, z - move, z)
            count += going
            going &= ~np.asarray(jnp.all(jnp.abs(move) <= TOLERANCE * (1.0 + jnp.abs(z)), axis=0))
            if not going.any():
                break
        self.residuals.append(np.max(np.abs(np.asarray(residual(z, args))), axis=0))
        self.iterations.append(count)
        return z


def stepped(program: Rollout, path: Jacobians, ops: Newton) -> np.ndarray:
    """Return the state after each step of ``path``, ``(n, T)``, computed with the steps as batch columns."""
    import jax.numpy as jnp

    before, u = jnp.asarray(path.states[:-1].T), jnp.asarray(path.controls.T)
    return np.concatenate([np.asarray(part) for part in program.step(ops, split(program.scene, before), u)])


def solved_again(program: Rollout, path: Jacobians) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the state after each step, ``(n, T)``, solved again by Newton's method, and the solver columns ``(T + 1,)``.

    A backend's own solver runs inside the compiled rollout and reports nothing. So each step is solved again from its
    state, with the law's own first guess. ``solver_residual`` is the largest component of the residual (in the unit of
    the law's equation), ``solver_iterations`` the number of Newton steps, including the last one, which is within
    tolerance, and ``solver_mismatch`` the largest difference from the state that the backend's solver reached.
    """
    ops = Newton()
    after = stepped(program, path, ops)
    return after, {
        "solver_residual": per_state(np.max(ops.residuals, axis=0)),
        "solver_iterations": per_state(np.sum(ops.iterations, axis=0)),
        "solver_mismatch": per_state(np.max(np.abs(after - path.states[1:].T), axis=0)),
    }
