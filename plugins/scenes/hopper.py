"""Hopping on one leg: repeated landing and lift-off, under feedback."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, EngineTwin, State, param

from .axis_contact import AxisContactScene


@dataclass(frozen=True)
class Hopper(EngineTwin, AxisContactScene):
    """A body on a spring-damper leg with a point foot hops on the spot; q = (body height z, foot height y).

    With the compression c = rest length - (z - y) the leg pushes body and foot apart with k c + b c' + u. The policy
    u = c z' (theta_0 + theta_1 (target - h)) makes the leg stiffer while the body rises than while it falls, more so
    if the energy height h = z + z'^2 / 2g + k c^2 / (2 M g), the next apex, is below target. theta holds the two
    gains; f = mean of (h - target)^2 over the steps, plus ``effort`` times the mean of u^2, plus (h - target)^2 at
    the end.

    The default lands and lifts off four times. Within a stance, the light foot rebounds under a penalty and remains on
    the ground under ``complementarity``; the hops are the same. The ``impulse`` law does not support hopping: it uses
    the velocity before the step, so that a loaded foot sinks at a speed of dt times the load's acceleration.
    """

    name = "hopper"
    continuous = True
    neglected_effects = "forward motion and pitch, the leg's angle and end stops, limits of the actuator"
    n_q = 2
    n_u = 1
    gap_axis = 1
    contact_mass = "foot_mass"
    twin_difference = 1e-3
    contact_values = {"stiffness": 1e4}

    sigma: float = param(1.0, "standard deviation of the noise on the force of each step", "N", positive=True)
    noise: str = param("action", "noise is on the actions", choices=("action",))
    horizon: int = 1000
    dt: float = 0.002
    body_mass: float = param(1.0, "M, mass of the body", "kg", positive=True)
    foot_mass: float = param(0.1, "mass of the foot", "kg", positive=True)
    leg: float = param(0.5, "rest length of the leg", "m", positive=True)
    leg_stiffness: float = param(400.0, "k, stiffness of the leg", "N/m", positive=True)
    leg_damping: float = param(6.0, "b, damping of the leg", "N s/m", low=0.0)
    gravity: float = param(9.81, "g", "m/s^2", positive=True)
    drop: float = param(0.15, "initial height of the foot", "m", positive=True)
    target: float = param(0.7, "target energy height", "m", positive=True)
    effort: float = param(1e-5, "weight of the mean squared force", "m^2/N^2", low=0.0)
    restitution: float = 0.0

    def theta0(self) -> np.ndarray:
        """Return 100 N s/m^2 and 400 N s/m^3, with which the default body hops a little below target."""
        return np.array([100.0, 400.0])

    def initial_state(self, xp: Any, theta: Array) -> State:
        return self.at_rest(xp, theta, self.drop + self.leg, self.drop)

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array:
        """Return c z' (theta_0 + theta_1 (target - h))."""
        gain = theta[0] + theta[1] * (self.target - self._energy_height(q, v))
        return xp.stack([self._compression(q) * v[0] * gain])

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        push = self.leg_stiffness * self._compression(q) + self.leg_damping * (v[1] - v[0]) + u[0]
        return xp.stack([push / self.body_mass - self.gravity, -push / self.foot_mass - self.gravity])

    def mjcf(self) -> str:
        return f"""
            <option gravity="0 0 {-self.gravity}"/>
            <worldbody>
              <geom name="ground" type="plane" size="1 1 1"/>
              <body>
                <joint name="body" type="slide" axis="0 0 1"/>
                <inertial pos="0 0 0" mass="{self.body_mass}" diaginertia="1 1 1"/>
              </body>
              <body>
                <joint name="foot" type="slide" axis="0 0 1"/>
                <geom name="foot" type="sphere" size="0.05" pos="0 0 0.05" mass="{self.foot_mass}"/>
              </body>
            </worldbody>
            <tendon>
              <fixed name="leg" springlength="{self.leg}" stiffness="{self.leg_stiffness}" damping="{self.leg_damping}">
                <joint joint="body" coef="1"/>
                <joint joint="foot" coef="-1"/>
              </fixed>
            </tendon>
            <contact><pair geom1="ground" geom2="foot" condim="1"/></contact>
            <actuator><motor tendon="leg"/></actuator>"""

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return (self.terminal_cost(xp, q, v) + self.effort * u[0] ** 2) / self.horizon

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return (self._energy_height(q, v) - self.target) ** 2

    def _compression(self, q: Array) -> Array:
        return self.leg - (q[0] - q[1])

    def _energy_height(self, q: Array, v: Array) -> Array:
        weight = self.body_mass * self.gravity
        return q[0] + v[0] ** 2 / (2 * self.gravity) + self.leg_stiffness * self._compression(q) ** 2 / (2 * weight)
