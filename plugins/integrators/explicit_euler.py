"""Explicit (forward) Euler."""

from dataclasses import dataclass

import numpy as np

from bench.model import Array, Dynamics, Integrator, State


@dataclass(frozen=True)
class ExplicitEuler(Integrator):
    """q+ = q + dt v, v+ = v + dt a(q, v, u).

    It increases the energy of an undamped oscillator at every dt.
    """

    name = "explicit_euler"
    moves_with = "old"

    def step(self, dynamics: Dynamics, state: State, u: Array, dt: float) -> State:
        v = dynamics.carried(state.v) + dt * dynamics.acceleration(state.q, state.v, u)
        return State(state.q + dt * state.v, v)

    def amplification(self, z: complex) -> complex:
        """Return 1 + z."""
        return 1 + z

    def transition(self, dt: float, stiffness: float, damping: float, factor: float) -> np.ndarray:
        return np.array([[1.0, dt], [-dt * stiffness, factor - dt * damping]])
