"""Stormer-Verlet, in its velocity form."""

from dataclasses import dataclass

import numpy as np

from bench.model import Array, Dynamics, Integrator, State


@dataclass(frozen=True)
class StormerVerlet(Integrator):
    """q+ = q + dt v + dt^2 a / 2, then v+ = v + dt (a + a+) / 2 with a+ = a(q+, v + dt a, u).

    Symplectic and reversible where the acceleration does not depend on the velocity; second order even where it does,
    since a+ is then taken at a predicted velocity. Stable on an undamped oscillator of frequency w while w dt <= 2.
    The velocity factor multiplies the velocity at the start of the step.
    Source: Hairer, Lubich, Wanner 2006.
    """

    name = "stormer_verlet"
    order = 2

    def step(self, dynamics: Dynamics, state: State, u: Array, dt: float) -> State:
        """Return the state after one step, with two evaluations of the acceleration."""
        return flight(dynamics, State(state.q, dynamics.carried(state.v)), u, dt)

    def amplification(self, z: complex) -> complex:
        """Return 1 + z + z^2 / 2."""
        return 1 + z + z * z / 2

    def transition(self, dt: float, stiffness: float, damping: float, factor: float) -> np.ndarray:
        position, velocity = np.eye(2)
        before = -stiffness * position - damping * velocity
        moved = position + dt * velocity + 0.5 * dt**2 * before
        after = -stiffness * moved - damping * (velocity + dt * before)
        return np.array([moved, velocity + 0.5 * dt * (before + after)]) @ np.diag([1.0, factor])


def flight(dynamics: Dynamics, state: State, u: Array, dt: Array | float) -> State:
    """Return the state after one step without velocity factor; ``dt`` may differ between columns, ``(1, B)``."""
    q, v = state
    a = dynamics.acceleration(q, v, u)
    moved = q + dt * (v + 0.5 * dt * a)
    return State(moved, v + 0.5 * dt * (a + dynamics.acceleration(moved, v + dt * a, u)))
