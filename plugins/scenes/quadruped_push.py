"""The quadruped pushes a block, for physics engines only."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, State, param

from .quadruped import Quadruped


@dataclass(frozen=True)
class QuadrupedPush(Quadruped):
    """A standing quadruped pushes a block, ``gap`` in front of its torso, by ``target``; the block slides with friction.

    q has the position x of the block after that of the robot. theta is a plan in the sagittal plane: offsets from the
    stance of the target angles of front hips, front knees, back hips and back knees (rad), at each of ``knots`` times,
    with parameter noise. f = block (1 - x / target)^2 + upright (pitch^2 + roll^2) at the end,
    plus effort |u|^2 / horizon in each step. Without contact x is 0 whatever theta is: the first term is block, and its
    gradient 0.
    """

    name = "quadruped_push"
    neglected_effects = (
        "joint limits, torque limits, self-collision, contacts other than the feet's and the torso's with the block, "
        "motion of the block other than along x"
    )
    n_q = 19
    n_contacts = 5
    contact_values = {"stiffness": 1e4, "damping": 400.0, "damping_mode": "clipped"}
    torso = f'name="torso" {Quadruped.torso}'

    sigma: float = param(0.02, "standard deviation of the noise on the offsets", "rad", positive=True)
    horizon: int = 60
    push: float = 0.0
    drift: float = 0.0
    target: float = param(0.05, "target of the block", "m", positive=True)
    knots: int = param(3, "number of equal parts of the horizon, each with its own offsets", positive=True)
    lean: float = param(0.0, "offset of all hips at theta, which moves the torso forward", "rad")
    gap: float = param(0.05, "distance between torso and block at the start", "m", positive=True)
    block_mass: float = param(4.0, "mass of the block", "kg", positive=True)
    block_friction: float = param(0.3, "Coulomb coefficient of the block on the ground", low=0.0)
    block: float = param(1.0, "weight of the block's distance from its target, relative to the first", low=0.0)
    upright: float = param(1.0, "weight of the squared pitch and roll", "1/rad^2", low=0.0)
    effort: float = param(1e-4, "weight of the mean squared torques", "1/(N m)^2", low=0.0)

    def theta0(self) -> np.ndarray:
        return np.tile([self.lean, 0.0, self.lean, 0.0], self.knots)

    def initial_state(self, xp: Any, theta: Array) -> State:
        q, v = super().initial_state(xp, theta)
        block = 0.0 * theta[:1]
        return State(xp.concat([q, block]), xp.concat([v, block]))

    def planned_controls(self, xp: Any, theta: Array) -> Array:
        plan = xp.reshape(theta, (self.knots, 4, theta.shape[1]))[np.arange(self.horizon) * self.knots // self.horizon]
        side = 0.0 * plan[:, 0]
        front, back = ([side, plan[:, i] + self.bend, plan[:, i + 1] - 2 * self.bend] for i in (0, 2))
        return self.gain * xp.stack([*front, *front, *back, *back], axis=1)

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array:
        """Return -gain angle - damping rate of the joints, ``(12, B)``."""
        return -self.gain * q[6:18] - self.damping * v[6:18]

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return self.effort / self.horizon * xp.sum(u * u, axis=0)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return self.block * (1.0 - q[18] / self.target) ** 2 + self.upright * (q[4] ** 2 + q[5] ** 2)

    def mjcf(self) -> str:
        """Return the robot and a block with a round face on a slide, which the torso can touch."""
        radius, height = 0.1, 2 * self.link * float(np.cos(self.bend)) + self.foot_radius + self.clearance
        return f"""{super().mjcf()}
            <worldbody>
              <body pos="{0.2 + self.gap + radius} 0 {height}">
                <joint name="block" type="slide" axis="1 0 0"
                       frictionloss="{self.block_friction * self.block_mass * self.gravity}"/>
                <geom name="block" type="sphere" size="{radius}" mass="{self.block_mass}"/>
              </body>
            </worldbody>
            <contact><pair geom1="torso" geom2="block" condim="1"/></contact>"""
