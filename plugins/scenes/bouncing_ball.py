"""A ball dropped on the ground: one stiff contact under gravity."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, EngineTwin, State, param

from . import bounces
from .axis_contact import AxisContactScene
from .bounces import bounced


@dataclass(frozen=True)
class BouncingBall(EngineTwin, AxisContactScene):
    """A ball on a vertical line under gravity; q is the height of its lowest point.

    State (q, v); theta = (initial height, initial velocity), with parameter noise; f = (q_T - target)^2.
    The default lands at 0.45 s and is on its way down again at T = 1 s.

    Under gravity, an impulse that uses the velocity at a step boundary has a wrong derivative at every dt, with or
    without time of impact: the impact speed then depends on theta only through jumps of the step in which the impact
    occurs. Finite differences over a range of theta that moves the impact by many steps are correct.
    """

    name = "bouncing_ball"
    theta_names = ("height", "velocity")
    uses = (bounces,)
    continuous = True
    neglected_effects = "horizontal motion, spin, air, the ball's shape"
    n_q = 1
    twin_difference = 1e-3
    contact_values = {"stiffness": 1e4}

    sigma: float = param(0.05, "standard deviation of the noise on height and velocity", "m and m/s", positive=True)
    horizon: int = 400
    dt: float = 0.0025
    mass: float = param(1.0, "mass of the ball", "kg", positive=True)
    gravity: float = param(9.81, "gravitational acceleration", "m/s^2", positive=True)
    height: float = param(1.0, "initial height at theta", "m", positive=True)
    velocity: float = param(0.0, "initial velocity at theta, upwards", "m/s")
    target: float = param(0.5, "target height at the end", "m")
    restitution: float = param(1.0, "restitution of impulse laws and of the physical gradient", low=0.0, high=1.0)

    def initial_state(self, xp: Any, theta: Array) -> State:
        return State(theta[0:1], theta[1:2])

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return 0.0 * q - self.gravity

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return (q[0] - self.target) ** 2

    def mjcf(self) -> str:
        """Return a sphere on a vertical slide, over a plane; its joint position is its lowest point."""
        return f"""
            <option gravity="0 0 {-self.gravity}"/>
            <worldbody>
              <geom name="ground" type="plane" size="1 1 1"/>
              <body>
                <joint name="height" type="slide" axis="0 0 1"/>
                <geom name="ball" type="sphere" size="0.1" pos="0 0 0.1" mass="{self.mass}"/>
              </body>
            </worldbody>
            <contact><pair geom1="ground" geom2="ball" condim="1"/></contact>"""

    def physical_gradient(self) -> np.ndarray | None:
        final = self._rigid_end()
        return None if final is None else np.asarray(2 * (final[0] - self.target) * final[1])

    def physical_cost(self) -> float | None:
        final = self._rigid_end()
        return None if final is None else (final[0] - self.target) ** 2

    def _rigid_end(self) -> tuple[float, np.ndarray] | None:
        """Return the height at T and its derivative by theta, ``(2,)``; None if the ball stops."""
        end, by_theta = self.horizon * self.dt, np.eye(2)
        return bounced(self.height, self.velocity, self.gravity, self.restitution, end, *by_theta)
