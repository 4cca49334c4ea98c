"""Momentum transfer through a stiff contact."""

from dataclasses import dataclass
from typing import Any

from bench.model import Array, ContactScene, DampedScene, EngineTwin, OpenLoopScene, State, ZeroOrderHoldScene, param


@dataclass(frozen=True)
class Pushing(EngineTwin, OpenLoopScene, ZeroOrderHoldScene, DampedScene, ContactScene):
    """Two bodies on a line, the first pushed by an open-loop force; they are in contact when closer than 1 m.

    State (x1, x2, v1, v2); theta is the force sequence (d = horizon / hold). f = sum over steps of the Q-weighted
    squared distance to the goal before the step plus u^2, divided by ``hold``, plus the same distance of the last
    state. Source: Suh et al. 2022.
    """

    name = "pushing"
    theta_names = ("push",)
    continuous = True
    neglected_effects = "rotation, friction, the second dimension, shapes (bodies are points with a rest distance)"
    n_q = 2
    n_u = 1
    n_contacts = 1
    twin_difference = 1e-6
    contact_values = {"stiffness": 1e3}

    sigma: float = param(0.3, "standard deviation of the noise on each force", "N", positive=True)
    horizon: int = 30
    dt: float = 0.005
    mass: float = param(0.1, "mass of each body", "kg", positive=True)
    velocity_factor: float = param(0.6, "factor on the velocities each step", low=0.0)
    push: float = param(0.1, "force of every step at theta", "N")
    speed: float = param(0.0, "initial and goal velocity of the first body", "m/s")
    restitution: float = 0.0

    def initial_state(self, xp: Any, theta: Array) -> State:
        zero = 0.0 * theta[0]
        return State(xp.stack([zero, zero + 1.0]), xp.stack([zero + self.speed, zero]))

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return xp.concat([u / self.mass, xp.zeros_like(u)])

    def gap(self, xp: Any, q: Array) -> Array:
        """Return x2 - x1 - 1."""
        return q[1:2] - q[0:1] - 1.0

    def gap_rate(self, xp: Any, q: Array, v: Array) -> Array:
        """Return v2 - v1."""
        return v[1:2] - v[0:1]

    def contact_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        return xp.concat([-force, force]) / self.mass

    def mjcf(self) -> str:
        """Return two spheres of radius 0.5 m on a line, with joint damping (1 - velocity_factor) m / dt."""
        damping = (1.0 - self.velocity_factor) * self.mass / self.dt
        bodies = "".join(
            f"""
              <body>
                <joint name="{name}" type="slide" axis="1 0 0" damping="{damping}"/>
                <geom name="{name}" type="sphere" size="0.5" mass="{self.mass}"/>
              </body>"""
            for name in ("first", "second")
        )
        return f"""
            <worldbody>{bodies}
            </worldbody>
            <contact><pair geom1="first" geom2="second" condim="1"/></contact>
            <actuator><motor joint="first"/></actuator>"""

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        push = u[0]
        cost = self.terminal_cost(xp, q, v) + push * push
        return cost if self.hold == 1 else cost / self.hold

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the squared distance to x = (1, 2), v = (speed, 0), weighted by (0.1, 10, 0.1, 0.1)."""
        (x1, x2), (v1, v2) = q, v
        return 0.1 * (x1 - 1.0) ** 2 + 10.0 * (x2 - 2.0) ** 2 + 0.1 * (v1 - self.speed) ** 2 + 0.1 * v2**2
