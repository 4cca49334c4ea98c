"""Explicit midpoint rule."""

from dataclasses import dataclass

import numpy as np

from bench.model import Array, Dynamics, Integrator, State


@dataclass(frozen=True)
class Midpoint(Integrator):
    """Half an explicit Euler step, then a full step with the derivatives at the midpoint: second-order Runge-Kutta.

    The velocity factor multiplies the velocity at the start of the step, before all stages. The energy of an undamped
    oscillator of frequency w grows at every dt, by a factor 1 + (w dt)^4 / 4 per step.
    """

    name = "midpoint"
    order = 2

    def step(self, dynamics: Dynamics, state: State, u: Array, dt: float) -> State:
        """Return the state after one step, with two evaluations of the acceleration."""
        q, v = state.q, dynamics.carried(state.v)
        middle = v + 0.5 * dt * dynamics.acceleration(q, v, u)
        return State(q + dt * middle, v + dt * dynamics.acceleration(q + 0.5 * dt * v, middle, u))

    def amplification(self, z: complex) -> complex:
        """Return 1 + z + z^2 / 2."""
        return 1 + z + z * z / 2

    def transition(self, dt: float, stiffness: float, damping: float, factor: float) -> np.ndarray:
        """Return I + Z + Z^2 / 2 with Z = dt times the system matrix, after the velocity factor."""
        z = dt * np.array([[0.0, 1.0], [-stiffness, -damping]])
        return (np.eye(2) + z + z @ z / 2) @ np.diag([1.0, factor])
