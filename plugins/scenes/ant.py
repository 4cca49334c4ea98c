"""A robot with four spread legs of two joints, for physics engines only."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, State, param

from .legged import Legged

DIRECTIONS = {"a": 45, "b": 135, "c": 225, "d": 315}
"""Direction of each leg in the plane [deg]."""


@dataclass(frozen=True)
class Ant(Legged):
    """A round torso on four spread legs lands on its four feet, with friction, under constant torques.

    q = (x, y, z, yaw, pitch, roll) of the torso, then hip (about the vertical) and ankle of each leg. theta holds the
    constant torques of the 8 leg joints (N m), with parameter noise. f = x of the torso at the end, with minus sign.
    """

    name = "ant"
    n_q = 14
    n_u = 8
    legs = tuple(DIRECTIONS)
    joints = ("hip", "ankle")
    torso = 'type="sphere" size=".15"'
    contact_values = {"stiffness": 1e4, "damping": 100.0, "damping_mode": "clipped"}

    sigma: float = param(0.1, "standard deviation of the noise on the torques", "N m", positive=True)
    horizon: int = 30
    link: float = param(0.2, "length of a thigh; a shank is twice as long", "m", positive=True)
    damping: float = param(0.3, "damping of the joints", "N m s/rad", low=0.0)
    stiffness: float = param(4.0, "stiffness of the joints", "N m/rad", low=0.0)
    fall: float = param(0.5, "initial downward velocity", "m/s")
    speed: float = param(0.5, "initial forward velocity", "m/s")
    torque: float = param(0.5, "torque of each joint at theta; hips alternate in sign", "N m")

    def theta0(self) -> np.ndarray:
        return self.torque * np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0, -1.0, 1.0])

    def initial_state(self, xp: Any, theta: Array) -> State:
        zero = 0.0 * theta[0]
        height = 2 * self.link * float(np.sin(np.pi / 4)) + self.foot_radius + self.clearance
        q = [zero, zero, zero + height, *([zero] * 11)]
        v = [zero + self.speed, zero, zero - self.fall, *([zero] * 11)]
        return State(xp.stack(q), xp.stack(v))

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array:
        """Return the torques theta, less a spring and a damper in each joint, ``(8, B)``."""
        return theta - self.stiffness * q[6:] - self.damping * v[6:]

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return -q[0]

    def leg(self, name: str) -> str:
        """Return a leg: a level thigh, a shank that slopes down at 45 degrees, and a foot."""
        down = 2 * self.link * float(np.sin(np.pi / 4))
        size = 0.1 * self.link
        return f"""
            <body euler="0 0 {DIRECTIONS[name]}">
              <joint class="motor" name="{name}_hip" type="hinge" axis="0 0 1" pos=".15 0 0"/>
              <geom type="capsule" fromto=".15 0 0 {0.15 + self.link} 0 0" size="{size}" mass="{self.leg_mass}"/>
              <body pos="{0.15 + self.link} 0 0">
                <joint class="motor" name="{name}_ankle" type="hinge" axis="0 1 0"/>
                <geom type="capsule" fromto="0 0 0 {down} 0 {-down}" size="{size}" mass="{self.leg_mass}"/>
                <geom name="{name}" type="sphere" size="{self.foot_radius}" pos="{down} 0 {-down}" mass="0"/>
              </body>
            </body>"""
