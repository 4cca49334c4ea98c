"""A mass pushed along a line: dynamics for which gradient and variance have closed forms."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, EngineTwin, OpenLoopScene, Plugin, State, param


@dataclass(frozen=True)
class DoubleIntegrator(EngineTwin, OpenLoopScene):
    """q'' = u from rest at q = 0; state (q, v), theta the controls u_0 .. u_{N-1}; f = (q_N - 1)^2 / 2.

    q_N = c . u with c_i = dt^2 (N - i) for semi-implicit and dt^2 (N - i - 1) for explicit Euler. Hence grad J =
    (c . theta - 1) c for any sigma, and a sample's gradient has covariance sigma^2 |c|^2 c c^T: trace sigma^2 |c|^4.
    """

    name = "double_integrator"
    theta_names = ("control",)
    neglected_effects = "contact, friction, effort in the cost"
    continuous = True
    n_q = 1
    n_u = 1

    sigma: float = param(0.1, "standard deviation of the noise on each control", "m/s^2", positive=True)
    horizon: int = 20
    dt: float = 0.05
    control: float = param(1.0, "control of every step at theta", "m/s^2")

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return the state at rest at 0."""
        return self.at_rest(xp, theta, 0.0)

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return u

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Return half the squared distance to q = 1."""
        return 0.5 * (q[0] - 1.0) ** 2

    def mjcf(self) -> str:
        """Return a mass of 1 kg on a slide."""
        return """
            <worldbody>
              <body>
                <joint name="track" type="slide" axis="1 0 0"/>
                <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
              </body>
            </worldbody>
            <actuator><motor joint="track"/></actuator>"""

    def sensitivity(self, integrator: Plugin | None) -> np.ndarray | None:
        """Return c = d q_N / d u, ``(horizon,)``, or None for an integrator without a formula here."""
        late = {"new": 0, "old": 1}.get(getattr(integrator, "moves_with", ""))
        return None if late is None else np.asarray(self.dt**2 * (self.horizon - late - np.arange(self.horizon)))

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray | None:
        """Return (c . theta - 1) c."""
        c = self.sensitivity(integrator)
        return None if c is None else (c @ self.theta0() - 1.0) * c
