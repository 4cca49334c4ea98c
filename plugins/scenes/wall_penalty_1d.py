"""A point that hits a soft wall: the finite step size is enough to make a penalty gradient wrong."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, EngineTwin, State, param

from .axis_contact import AxisContactScene


@dataclass(frozen=True)
class WallPenalty1d(EngineTwin, AxisContactScene):
    """A point of mass 1 at q0 > 0 moves at velocity -1 into a wall at q = 0, which pushes with -v - 50 q, unclipped.

    State (q, v); theta = q0 (d = 1), with parameter noise; f = |q_T - 1| with T = horizon dt = 2 s. The wall is a
    penalty law with the values of ``contact_values``. Unlike in other scenes, the softness is part of the physics, so
    the physical gradient is the limit dt -> 0 with this wall. The damper acts from first touch, so that the program
    jumps by O(dt) each time q0 grows by one step's travel. As dt -> 0 its derivative tends to the physical one only for
    rollouts that leave the wall again, not for rollouts that end in it. Source: Paulus et al. 2025, toy example.
    """

    name = "wall_penalty_1d"
    theta_names = ("start",)
    continuous = True
    neglected_effects = "gravity, the second and third dimension, shapes"
    n_q = 1
    twin_difference = 1e-3
    contact_values = {"stiffness": 50.0, "damping": 1.0, "damping_mode": "linear"}

    sigma: float = param(0.1, "standard deviation of the noise on q0", "m", positive=True)
    horizon: int = 200
    start: float = param(0.6, "q0 at theta", "m")

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return position q0, moving towards the wall at 1 m/s."""
        return State(theta[0:1], 0.0 * theta[0:1] - 1.0)

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Return zero: only the wall pushes."""
        return 0.0 * v

    def contact_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        """Return the acceleration away from the wall, for mass 1."""
        return force

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the distance to q = 1."""
        return xp.abs(q[0] - 1.0)

    def mjcf(self) -> str:
        """Return a sphere on a slide, in front of a plane; its joint position is its point nearest to the wall.

        An engine's contact never pulls, so this is the twin of the wall with ``damping_mode=clipped``, not of the
        default wall.
        """
        return """
            <worldbody>
              <geom name="wall" type="plane" size="1 1 1" zaxis="1 0 0"/>
              <body>
                <joint name="track" type="slide" axis="1 0 0"/>
                <geom name="point" type="sphere" size="0.1" pos="0.1 0 0" mass="1"/>
              </body>
            </worldbody>
            <contact><pair geom1="wall" geom2="point" condim="1"/></contact>"""

    def breakpoints(self) -> tuple[tuple[float, ...], ...]:
        """Return the kinks of the physical cost, as values of q0.

        In order: the point starts at the wall, ends at q = 1 after a bounce, ends as it leaves the wall, ends at first
        touch, and ends at q = 1 without touching the wall.

        A program also jumps, by O(dt), wherever contact begins or ends on the boundary between two steps.
        """
        end = self.horizon * self.dt
        _, duration, speed = self._wall()
        return ((0.0, end - duration - 1.0 / speed, end - duration, end, end + 1.0),)

    def physical_gradient(self) -> np.ndarray | None:
        """Return the exact gradient for dt -> 0 under the penalty wall; None for a start inside the wall."""
        if self.start < 0.0:
            return None
        reached, slope = self._soft_end()
        return np.array([slope if reached > 1.0 else -slope])

    def physical_cost(self) -> float | None:
        """Return f for dt -> 0 under the penalty wall; None for a start inside the wall."""
        return None if self.start < 0.0 else abs(self._soft_end()[0] - 1.0)

    def _soft_end(self) -> tuple[float, float]:
        """Return q_T and its derivative by q0, for a start outside the wall."""
        rate, duration, speed = self._wall()
        inside = self.horizon * self.dt - self.start  # time since first touch
        if inside <= 0.0:
            return -inside, 1.0
        if inside < duration:
            half = 0.5 * self.contact_values["damping"]
            decay, sine = math.exp(-half * inside), math.sin(rate * inside) / rate
            return -decay * sine, decay * (math.cos(rate * inside) - half * sine)
        return speed * (inside - duration), -speed

    def _wall(self) -> tuple[float, float, float]:
        """Return the angular frequency of a contact, its duration, and the speed after it."""
        half = 0.5 * self.contact_values["damping"]
        rate = math.sqrt(self.contact_values["stiffness"] - half * half)
        duration = math.pi / rate
        return rate, duration, math.exp(-half * duration)
