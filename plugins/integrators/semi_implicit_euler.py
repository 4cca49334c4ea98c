"""Semi-implicit (symplectic) Euler."""

from dataclasses import dataclass

import numpy as np

from bench.model import Array, Dynamics, Integrator, State


@dataclass(frozen=True)
class SemiImplicitEuler(Integrator):
    """v+ = v + dt a(q, v, u), then q+ = q + dt v+.

    Stable on x'' = -w^2 x with velocity factor d while (w dt)^2 < 2 (1 + d).
    """

    name = "semi_implicit_euler"
    takes_impulses = True
    moves_with = "new"

    def step(self, dynamics: Dynamics, state: State, u: Array, dt: float) -> State:
        v = dynamics.carried(state.v) + dt * dynamics.acceleration(state.q, state.v, u)
        return dynamics.with_impulse(state, State(state.q + dt * v, v), dt)

    def amplification(self, z: complex) -> complex:
        """Return 1 + z: without positions this is explicit Euler."""
        return 1 + z

    def transition(self, dt: float, stiffness: float, damping: float, factor: float) -> np.ndarray:
        row = np.array([-dt * stiffness, factor - dt * damping])
        return np.array([[1.0, 0.0] + dt * row, row])
