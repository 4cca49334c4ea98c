"""Implicit midpoint rule."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, Dynamics, Integrator, State


@dataclass(frozen=True)
class ImplicitMidpoint(Integrator):
    """v+ = v + dt a(q + dt m / 2, m, u) with m = (v + v+) / 2; then q+ = q + dt m.

    Symplectic, and stable at every dt if the motion is stable. It conserves the energy of linear oscillators exactly,
    so that stiff modes keep oscillating where implicit Euler damps them. Differentiated through the implicit-function
    theorem; the unknown is the displacement dt m, for which rounding errors of a stiff force stay below the solver's
    tolerance. The velocity factor multiplies the velocity at the start of the step. Source: Hairer, Lubich, Wanner
    2006.
    """

    name = "implicit_midpoint"
    order = 2
    needs_root = True

    def step(self, dynamics: Dynamics, state: State, u: Array, dt: float) -> State:

        def residual(moved: Array, args: Any) -> Array:
            q, v, u, dt = args
            return moved - dt * (v + 0.5 * dt * dynamics.acceleration(q + 0.5 * moved, moved / dt, u))

        v = dynamics.carried(state.v)
        moved = dynamics.ops.root(residual, dt * v, (state.q, v, u, dt))
        return State(state.q + moved, 2.0 * moved / dt - v)

    def amplification(self, z: complex) -> complex:
        """Return (1 + z / 2) / (1 - z / 2)."""
        return (1 + z / 2) / (1 - z / 2)

    def transition(self, dt: float, stiffness: float, damping: float, factor: float) -> np.ndarray:
        """Return (I - Z / 2)^-1 (I + Z / 2) with Z = dt times the system matrix, after the velocity factor."""
        half, one = 0.5 * dt * np.array([[0.0, 1.0], [-stiffness, -damping]]), np.eye(2)
        return np.linalg.solve(one - half, one + half) @ np.diag([1.0, factor])
