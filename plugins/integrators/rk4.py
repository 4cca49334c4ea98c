"""The classical Runge-Kutta method."""

from dataclasses import dataclass

import numpy as np

from bench.model import Array, Dynamics, Integrator, State


@dataclass(frozen=True)
class Rk4(Integrator):
    """Four explicit stages, weighted 1, 2, 2, 1.

    The velocity factor multiplies the velocity at the start of the step, before all stages. Stable on an undamped
    oscillator of frequency w while w dt <= 2 sqrt(2). A contact that begins within a step reduces the order.
    """

    name = "rk4"
    order = 4

    def step(self, dynamics: Dynamics, state: State, u: Array, dt: float) -> State:
        """Return the state after one step, with four evaluations of the acceleration."""
        q, v1 = state.q, dynamics.carried(state.v)
        a1 = dynamics.acceleration(q, v1, u)
        v2 = v1 + 0.5 * dt * a1
        a2 = dynamics.acceleration(q + 0.5 * dt * v1, v2, u)
        v3 = v1 + 0.5 * dt * a2
        a3 = dynamics.acceleration(q + 0.5 * dt * v2, v3, u)
        v4 = v1 + dt * a3
        a4 = dynamics.acceleration(q + dt * v3, v4, u)
        return State(q + dt / 6.0 * (v1 + 2.0 * (v2 + v3) + v4), v1 + dt / 6.0 * (a1 + 2.0 * (a2 + a3) + a4))

    def amplification(self, z: complex) -> complex:
        """Return the exponential series up to z^4."""
        return 1 + z * (1 + z / 2 * (1 + z / 3 * (1 + z / 4)))

    def transition(self, dt: float, stiffness: float, damping: float, factor: float) -> np.ndarray:
        z, one = dt * np.array([[0.0, 1.0], [-stiffness, -damping]]), np.eye(2)
        series = one + z @ (one + z / 2 @ (one + z / 3 @ (one + z / 4)))
        return series @ np.diag([1.0, factor])
