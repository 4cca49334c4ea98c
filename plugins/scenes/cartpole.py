"""Balancing a pole on a cart: a feedback policy, for which noise on actions and noise on theta differ."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, EngineTwin, MechanicalScene, State, param


@dataclass(frozen=True)
class Cartpole(EngineTwin, MechanicalScene):
    """A point mass m on a massless pole of length l on a cart M, under the linear policy u = -K (x, a, x', a').

    State (x, a, x', a') with the angle a from upright, starting at rest at ``angle``; theta = K (d = 4).
    x'' = (u + m sin a (l a'^2 - g cos a)) / (M + m sin^2 a) and a'' = (g sin a - x'' cos a) / l.
    f = dt sum (x^2 + 10 a^2 + 0.01 u^2) plus x^2 + 10 a^2 + 0.1 x'^2 + 0.1 a'^2 at the end.
    ``noise=action`` perturbs the force of each step, so that the score is a sum over the visited states.
    ``noise=parameter`` perturbs the gains by the same sigma.
    """

    name = "cartpole"
    neglected_effects = "the track's ends, friction, the pole's inertia about its tip"
    continuous = True
    n_q = 2
    n_u = 1

    sigma: float = param(0.1, "standard deviation of the noise on each force, or on each gain", "N", positive=True)
    horizon: int = 50
    dt: float = 0.02
    noise: str = param("action", "whether noise is on the actions or on theta", choices=("action", "parameter"))
    cart_mass: float = param(1.0, "M", "kg", positive=True)
    pole_mass: float = param(0.1, "m", "kg", positive=True)
    length: float = param(0.5, "l, length of the pole", "m", positive=True)
    gravity: float = param(9.81, "gravitational acceleration", "m/s^2")
    angle: float = param(0.2, "initial angle of the pole from upright", "rad")

    def theta0(self) -> np.ndarray:
        """Return gains (-3, -40, -4, -8): near the optimum of the quadratic cost, stable with the default masses."""
        return np.array([-3.0, -40.0, -4.0, -8.0])

    def initial_state(self, xp: Any, theta: Array) -> State:
        return self.at_rest(xp, theta, 0.0, self.angle)

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array:
        """Return -K (x, a, x', a')."""
        return -(theta[0:1] * q[0:1] + theta[1:2] * q[1:2] + theta[2:3] * v[0:1] + theta[3:4] * v[1:2])

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        sine, cosine = xp.sin(q[1]), xp.cos(q[1])
        swing = self.length * v[1] * v[1] - self.gravity * cosine
        cart = (u[0] + self.pole_mass * sine * swing) / (self.cart_mass + self.pole_mass * sine * sine)
        return xp.stack([cart, (self.gravity * sine - cart * cosine) / self.length])

    def mjcf(self) -> str:
        return f"""
            <option gravity="0 0 {-self.gravity}"/>
            <worldbody>
              <body>
                <joint name="track" type="slide" axis="1 0 0"/>
                <inertial pos="0 0 0" mass="{self.cart_mass}" diaginertia="1 1 1"/>
                <body>
                  <joint name="pole" type="hinge" axis="0 1 0"/>
                  <inertial pos="0 0 {self.length}" mass="{self.pole_mass}" diaginertia="1e-12 1e-12 1e-12"/>
                </body>
              </body>
            </worldbody>
            <actuator><motor joint="track"/></actuator>"""

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return self.dt * (q[0] ** 2 + 10.0 * q[1] ** 2 + 0.01 * u[0] ** 2)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return q[0] ** 2 + 10.0 * q[1] ** 2 + 0.1 * v[0] ** 2 + 0.1 * v[1] ** 2
