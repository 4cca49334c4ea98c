"""Implicit (backward) Euler."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, Dynamics, Integrator, State


@dataclass(frozen=True)
class ImplicitEuler(Integrator):
    """v+ = d v + dt a(q + dt v+, v+, u) with velocity factor d; then q+ = q + dt v+.

    Stable at every dt if the motion is stable, contact springs of a force law included, but it loses energy.
    Differentiated through the implicit-function theorem; the unknown is the displacement dt v+, for which rounding
    errors of a stiff force stay below the solver's tolerance. Impulses of an impulse law act after the solved step and
    change the position as in semi-implicit Euler; they are not part of the equation. With a force that jumps, such as a
    damper at touch, the equation may have no root: such a rollout is not finite.
    """

    name = "implicit_euler"
    order = 1
    takes_impulses = True
    needs_root = True

    def step(self, dynamics: Dynamics, state: State, u: Array, dt: float) -> State:
        """Return the state after one step, which solves one equation for the displacement dt v+."""

        def residual(moved: Array, args: Any) -> Array:
            q, carried, u, dt = args
            v = moved / dt
            return moved - dt * (carried + dt * dynamics.acceleration(q + moved, v, u))

        carried = dynamics.carried(state.v)
        moved = dynamics.ops.root(residual, dt * carried, (state.q, carried, u, dt))
        v = moved / dt
        return dynamics.with_impulse(state, State(state.q + dt * v, v), dt)

    def amplification(self, z: complex) -> complex:
        """Return 1 / (1 - z)."""
        return 1 / (1 - z)

    def transition(self, dt: float, stiffness: float, damping: float, factor: float) -> np.ndarray:
        """Return the matrix for v+ = (d v - dt stiffness q) / (1 + dt damping + dt^2 stiffness) and q+ = q + dt v+."""
        row = np.array([-dt * stiffness, factor]) / (1.0 + dt * damping + dt**2 * stiffness)
        return np.array([[1.0, 0.0] + dt * row, row])
