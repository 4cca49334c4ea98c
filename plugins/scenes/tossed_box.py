"""A box thrown on the ground, for physics engines only: four corners that slide, stick and bounce."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, EngineScene, State, param


@dataclass(frozen=True)
class TossedBox(EngineScene):
    """A square box in a vertical plane lands on its corners, tumbles and slides; q = (x, height, pitch) of its centre.

    State (q, v); theta is the initial velocity (m/s, m/s, rad/s), with parameter noise; f = (x_T - target)^2. Four
    contacts with friction are coupled through one body, so only physics engines can run it, from the MJCF twin.
    """

    name = "tossed_box"
    continuous = True
    neglected_effects = "the third dimension, edges and faces (corners are small spheres)"
    n_q = 3
    n_contacts = 4
    contact_values = {"stiffness": 1e4, "damping": 50.0, "damping_mode": "clipped"}

    sigma: float = param(0.1, "standard deviation of the noise on the initial velocity", "m/s and rad/s", positive=True)
    horizon: int = 250
    dt: float = 0.002
    mass: float = param(1.0, "mass of the box", "kg", positive=True)
    side: float = param(0.2, "length of a side", "m", positive=True)
    friction: float = param(0.5, "Coulomb coefficient", low=0.0)
    gravity: float = param(9.81, "gravitational acceleration", "m/s^2", positive=True)
    height: float = param(0.3, "initial height of the centre", "m", positive=True)
    speed: float = param(1.5, "initial horizontal velocity at theta", "m/s")
    spin: float = param(2.0, "initial angular velocity at theta", "rad/s")
    target: float = param(0.5, "target horizontal position at the end", "m")

    def theta0(self) -> np.ndarray:
        return np.array([self.speed, 0.0, self.spin])

    def initial_state(self, xp: Any, theta: Array) -> State:
        zero = 0.0 * theta[0]
        return State(xp.stack([zero, zero + self.height, zero]), theta)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return (q[0] - self.target) ** 2

    def mjcf(self) -> str:
        inertia = self.mass * self.side**2 / 6
        radius, half = 0.05 * self.side, 0.45 * self.side
        corners = {f"corner{i}{j}": (i * half, j * half) for i in (-1, 1) for j in (-1, 1)}
        geoms = "".join(
            f'<geom name="{name}" type="sphere" size="{radius}" pos="{x} 0 {z}" mass="0"/>'
            for name, (x, z) in corners.items()
        )
        pairs = "".join(
            f'<pair geom1="ground" geom2="{name}" condim="3" friction="{self.friction} {self.friction} 1 1 1"/>'
            for name in corners
        )
        return f"""
            <option gravity="0 0 {-self.gravity}"/>
            <worldbody>
              <geom name="ground" type="plane" size="1 1 1"/>
              <body>
                <joint name="x" type="slide" axis="1 0 0"/>
                <joint name="height" type="slide" axis="0 0 1"/>
                <joint name="pitch" type="hinge" axis="0 1 0"/>
                <inertial pos="0 0 0" mass="{self.mass}" diaginertia="{inertia} {inertia} {inertia}"/>
                {geoms}
              </body>
            </worldbody>
            <contact>{pairs}</contact>"""
