"""A thrown ball meets the ground and a wall: two contacts, with gravity."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactScene, State, param

from . import bounces
from .bounces import bounced


@dataclass(frozen=True)
class GroundWall(ContactScene):
    """A ball bounces off the ground, y = 0, and off a wall to its right; q = (x, y) is its centre.

    State (q, v); theta = initial velocity (d = 2), with parameter noise; f = squared distance to the target at T.
    Contacts are (ground, wall), both frictionless, so that x and y do not interact. Under gravity, the impulse law has
    a wrong derivative by vy at every dt (see ``bouncing_ball``). Its derivative by vx is correct with the time of
    impact and has the wrong sign without it. The penalty's damper acts immediately at first touch, so that the program
    jumps by O(dt) where contact begins on a step boundary: the mean of its gradients is not the gradient of its mean.
    Source: Zhong, Han, Brikis 2022, task 2.
    """

    name = "ground_wall"
    theta_names = ("velocity_x", "velocity_y")
    uses = (bounces,)
    continuous = True
    neglected_effects = "spin, friction, air, the corner of ground and wall"
    n_q = 2
    n_contacts = 2
    contact_values = {"stiffness": 1e4, "damping": 10.0, "damping_mode": "approach"}

    sigma: float = param(0.1, "standard deviation of the noise on the velocity", "m/s", positive=True)
    horizon: int = 288
    dt: float = 0.6 / 288.0
    mass: float = param(1.0, "mass of the ball", "kg", positive=True)
    radius: float = param(0.1, "radius of the ball", "m", positive=True)
    gravity: float = param(9.8, "gravitational acceleration", "m/s^2", low=0.0)
    restitution: float = param(0.92, "restitution of impulse laws and of the physical gradient", low=0.0, high=1.0)
    wall: float = param(1.75, "x of the wall", "m")
    start_x: float = param(-0.5, "initial x of the centre", "m")
    start_y: float = param(1.0, "initial y of the centre", "m")
    velocity_x: float = param(5.0, "initial velocity at theta, to the right", "m/s")
    velocity_y: float = param(-5.0, "initial velocity at theta, upwards", "m/s")
    target_x: float = param(-2.0, "x of the target", "m")
    target_y: float = param(1.5, "y of the target", "m")

    def initial_state(self, xp: Any, theta: Array) -> State:
        zero = 0.0 * theta[0]
        return State(xp.stack([zero + self.start_x, zero + self.start_y]), theta)

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return xp.stack([0.0 * v[0], 0.0 * v[1] - self.gravity])

    def gap(self, xp: Any, q: Array) -> Array:
        return xp.stack([q[1] - self.radius, self.wall - self.radius - q[0]])

    def gap_rate(self, xp: Any, q: Array, v: Array) -> Array:
        return xp.stack([v[1], -v[0]])

    def contact_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        return xp.stack([-force[1], force[0]]) / self.mass

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return (q[0] - self.target_x) ** 2 + (q[1] - self.target_y) ** 2

    def physical_gradient(self) -> np.ndarray | None:
        final = self._rigid_end()
        if final is None:
            return None
        (x, x_slope), (y, y_slope) = final
        return np.array([2 * (x - self.target_x) * x_slope, 2 * (y - self.target_y) * y_slope])

    def physical_cost(self) -> float | None:
        final = self._rigid_end()
        return None if final is None else (final[0][0] - self.target_x) ** 2 + (final[1][0] - self.target_y) ** 2

    def _rigid_end(self) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Return (x, dx/dvx) and (y, dy/dvy) at T; None if the ball stops."""
        end, e = self.horizon * self.dt, self.restitution
        from_wall = bounced(self.wall - self.radius - self.start_x, -self.velocity_x, 0.0, e, end, 0.0, 1.0)
        from_ground = bounced(self.start_y - self.radius, self.velocity_y, self.gravity, e, end, 0.0, 1.0)
        if from_wall is None or from_ground is None:
            return None
        return (self.wall - self.radius - from_wall[0], from_wall[1]), (self.radius + from_ground[0], from_ground[1])
