"""Two masses on a stiff spring: stability and energy of every integrator."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, DampedScene, Integrator, Oscillator, Plugin, State, param


@dataclass(frozen=True)
class MassSpring(Oscillator, DampedScene):
    """Two equal masses joined by a spring and damper, reduced to the spring's stretch: m q'' = -2 k q - 2 c q'.

    State (q, v), stretch and its rate; theta = their initial values, with parameter noise; f = q_N^2. With r the first
    row of the N-th power of the integrator's transition matrix, q_N = r . theta and grad J = 2 (r . theta) r for any
    sigma. Semi-implicit Euler with velocity factor d is unstable when dt^2 2 k / m > 2 (1 + d), explicit Euler
    without damping is always unstable. The gradient then grows with the horizon as the trajectory does.
    """

    name = "mass_spring"
    theta_names = ("stretch", "rate")
    neglected_effects = "the centre of mass (moves uniformly)"
    continuous = True
    n_q = 1

    sigma: float = param(0.01, "standard deviation of the noise on stretch and rate", "m and m/s", positive=True)
    stiffness: float = param(50.0, "k of the spring", "N/m", low=0.0)
    damping: float = param(0.0, "c of the damper beside the spring", "N s/m", low=0.0)
    mass: float = param(1.0, "m, mass of each body", "kg", positive=True)
    stretch: float = param(0.1, "initial stretch at theta", "m")
    rate: float = param(0.0, "initial rate of the stretch at theta", "m/s")

    def initial_state(self, xp: Any, theta: Array) -> State:
        return State(theta[0:1], theta[1:2])

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return -2.0 / self.mass * (self.stiffness * q + self.damping * v)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return q[0] * q[0]

    def oscillator(self) -> tuple[float, float, float]:
        """Return stiffness 2 k / m [1/s^2], damping 2 c / m [1/s] and velocity factor, for transition matrices."""
        return 2.0 * self.stiffness / self.mass, 2.0 * self.damping / self.mass, self.velocity_factor

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray | None:
        """Return 2 (r . theta) r."""
        if not isinstance(integrator, Integrator):
            return None
        step = integrator.transition(self.dt, *self.oscillator())
        return self._gradient(np.linalg.matrix_power(step, self.horizon)[0])

    def physical_gradient(self) -> np.ndarray | None:
        """Return 2 (r . theta) r with r the first row of exp(T A), A the oscillator's matrix.

        None with a velocity factor, which is not physical.
        """
        if self.velocity_factor != 1.0:
            return None
        from scipy.linalg import expm

        stiffness, damping, _ = self.oscillator()
        system = np.array([[0.0, 1.0], [-stiffness, -damping]])
        return self._gradient(expm(self.horizon * self.dt * system)[0])

    def _gradient(self, row: np.ndarray) -> np.ndarray:
        return 2.0 * (row @ self.theta0()) * row
