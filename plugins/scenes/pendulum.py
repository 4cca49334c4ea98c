"""Swinging up a pendulum: smooth nonlinear dynamics."""

from dataclasses import dataclass
from typing import Any

from bench.model import Array, EngineTwin, OpenLoopScene, State, param


@dataclass(frozen=True)
class Pendulum(EngineTwin, OpenLoopScene):
    """A point mass on a rod, hanging at rest: m l^2 q'' = u - m g l sin q - b q'; q from the lowest point.

    State (q, q'); theta is the torque of each step (d = horizon). f = 1 + cos q_T + 0.1 q'_T^2 (0 at rest upright)
    plus ``effort`` dt sum u^2.
    """

    name = "pendulum"
    theta_names = ("torque",)
    neglected_effects = "the rod's mass, torque limits, contact"
    continuous = True
    n_q = 1
    n_u = 1

    sigma: float = param(0.3, "standard deviation of the noise on each torque", "N m", positive=True)
    horizon: int = 50
    dt: float = 0.02
    mass: float = param(1.0, "mass at the tip", "kg", positive=True)
    length: float = param(0.5, "length of the rod", "m", positive=True)
    gravity: float = param(9.81, "gravitational acceleration", "m/s^2")
    damping: float = param(0.0, "b, torque per angular velocity at the pivot", "N m s", low=0.0)
    torque: float = param(2.0, "torque of every step at theta", "N m")
    effort: float = param(1e-3, "cost per squared torque and second", "1/(N^2 m^2 s)", low=0.0)

    def initial_state(self, xp: Any, theta: Array) -> State:
        return self.at_rest(xp, theta, 0.0)

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        inertia = self.mass * self.length * self.length
        return (u - self.damping * v) / inertia - self.gravity / self.length * xp.sin(q)

    def mjcf(self) -> str:
        """Return a point mass below a hinge; q is the angle from the lowest point."""
        return f"""
            <option gravity="0 0 {-self.gravity}"/>
            <worldbody>
              <body>
                <joint name="pivot" type="hinge" axis="0 1 0" damping="{self.damping}"/>
                <inertial pos="0 0 {-self.length}" mass="{self.mass}" diaginertia="1e-12 1e-12 1e-12"/>
              </body>
            </worldbody>
            <actuator><motor joint="pivot"/></actuator>"""

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return self.effort * self.dt * u[0] * u[0]

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the distance below the top in rod lengths, plus a tenth of the squared velocity."""
        return 1.0 + xp.cos(q[0]) + 0.1 * v[0] * v[0]
