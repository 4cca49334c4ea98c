"""A walking robot with four legs of three joints, for physics engines only."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, State, param

from .legged import Legged

SIDES = {"front_left": (1, 1), "front_right": (1, -1), "back_left": (-1, 1), "back_right": (-1, -1)}
"""Sign of the hip's x and y by leg."""


@dataclass(frozen=True)
class Quadruped(Legged):
    """A torso on four legs is pushed sideways and stands on four feet with friction; the joints are held by springs.

    q = (x, y, z, yaw, pitch, roll) of the torso, then abduction, hip and knee of each leg. theta holds the target angles
    of the 12 leg joints (rad), with parameter noise; u = gain (theta - angle) - damping rate. f = (x - target)^2 + y^2
    of the torso at the end.
    """

    name = "quadruped"
    n_q = 18
    n_u = 12
    legs = tuple(SIDES)
    joints = ("side", "hip", "knee")
    torso = 'type="box" size=".2 .1 .05"'
    contact_values = {"stiffness": 2e4, "damping": 200.0, "damping_mode": "clipped"}

    sigma: float = param(0.02, "standard deviation of the noise on the target angles", "rad", positive=True)
    horizon: int = 20
    mass: float = 8.0
    leg_mass: float = 0.4
    link: float = param(0.2, "length of a thigh and of a shank", "m", positive=True)
    gain: float = param(60.0, "stiffness of the joints' control", "N m/rad", low=0.0)
    damping: float = param(2.0, "damping of the joints' control", "N m s/rad", low=0.0)
    armature: float = 0.05
    friction: float = 0.6
    push: float = param(0.5, "initial forward velocity", "m/s")
    drift: float = param(0.3, "initial sideways velocity", "m/s")
    bend: float = param(0.6, "hip angle at theta; knees are bent by twice as much", "rad")
    target: float = param(0.1, "target forward position at the end", "m")

    def theta0(self) -> np.ndarray:
        return np.tile([0.0, self.bend, -2 * self.bend], 4)

    def initial_state(self, xp: Any, theta: Array) -> State:
        zero = 0.0 * theta[0]
        bend = zero + self.bend
        height = 2 * self.link * xp.cos(bend) + self.foot_radius + self.clearance
        q = [zero, zero, height, zero, zero, zero, *([zero, bend, -2 * bend] * 4)]
        v = [zero + self.push, zero + self.drift, *([zero] * 16)]
        return State(xp.stack(q), xp.stack(v))

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array:
        """Return the torques gain (theta - angle) - damping rate, ``(12, B)``."""
        return self.gain * (theta - q[6:]) - self.damping * v[6:]

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return (q[0] - self.target) ** 2 + q[1] ** 2

    def leg(self, name: str) -> str:
        """Return a leg: thigh and shank, both capsules, and a foot."""
        front, left = SIDES[name]
        bone = (
            f'<geom type="capsule" fromto="0 0 0 0 0 {-self.link}" size="{0.08 * self.link}" mass="{self.leg_mass}"/>'
        )
        return f"""
            <body pos="{0.2 * front} {0.12 * left} 0">
              <joint class="motor" name="{name}_side" type="hinge" axis="1 0 0"/>
              <joint class="motor" name="{name}_hip" type="hinge" axis="0 1 0"/>
              {bone}
              <body pos="0 0 {-self.link}">
                <joint class="motor" name="{name}_knee" type="hinge" axis="0 1 0"/>
                {bone}
                <geom name="{name}" type="sphere" size="{self.foot_radius}" pos="0 0 {-self.link}" mass="0"/>
              </body>
            </body>"""
