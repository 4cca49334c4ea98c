"""Solves the equations of a rollout's steps again, for the forces of their contacts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bench.measure.contacts import split
from bench.model import Array, Jacobians, LoopOps, Rollout

TOLERANCE, ITERATIONS = 1e-12, 64
"""Largest last Newton step of a solution, relative to 1 + |z|, and the most Newton steps."""


class Newton(LoopOps):
    """Operations on JAX arrays with a Newton ``root``."""

    def root(self, residual: Callable[[Array, Any], Array], guess: Array, args: Any) -> Array:
        """Return the root of each column; a column stops once its own Newton step is within tolerance."""
        import jax
        import jax.numpy as jnp

        def derivative(z: Array) -> Array:
            basis = jnp.eye(len(z))[:, :, None] + jnp.zeros_like(z)
            return jax.vmap(lambda e: jax.jvp(lambda y: residual(y, args), (z,), (e,))[1], out_axes=1)(basis)

        z, going = guess, np.ones(guess.shape[1], dtype=bool)
        for _ in range(ITERATIONS):
            move = jnp.linalg.solve(jnp.moveaxis(derivative(z), -1, 0), residual(z, args).T[:, :, None])[:, :, 0].T
            z = jnp.where(going, z - move, z)
            going &= ~np.asarray(jnp.all(jnp.abs(move) <= TOLERANCE * (1.0 + jnp.abs(z)), axis=0))
            if not going.any():
                break
        return z


def stepped(program: Rollout, path: Jacobians) -> np.ndarray:
    """Return the state after each step of ``path``, ``(n, T)``, computed with the steps as batch columns."""
    import jax.numpy as jnp

    before, u = jnp.asarray(path.states[:-1].T), jnp.asarray(path.controls.T)
    return np.concatenate([np.asarray(part) for part in program.step(Newton(jnp), split(program.scene, before), u)])
