"""One ball is pushed towards another. If it misses, the gradient is exactly zero."""

from dataclasses import dataclass
from typing import Any

from bench.model import Array, ContactScene, State, param


@dataclass(frozen=True)
class Billiard(ContactScene):
    """Two equal balls on a frictionless table; a force (4, u0) [N] acts on the first ball during the first step.

    q = (x1, y1, x2, y2); theta = u0 (d = 1), with parameter noise; f = squared distance of the second ball from the
    origin at T. The first ball hits if |u0| < 4 tan(asin(2 radius / distance)) = 2.189 N. Otherwise it misses, f does
    not depend on u0, and the derivative is exactly 0. Source: Paulus et al. 2025.
    """

    name = "billiard"
    theta_names = ("start",)
    continuous = True
    neglected_effects = "spin, friction, cushions, the third dimension"
    n_q = 4
    n_u = 2
    n_contacts = 1
    contact_values = {"stiffness": 1e3, "beta": 50.0}

    sigma: float = param(0.3, "standard deviation of the noise on u0", "N", positive=True)
    horizon: int = 300
    mass: float = param(0.17, "mass of each ball", "kg", positive=True)
    radius: float = param(0.042, "radius of each ball", "m", positive=True)
    push: float = param(4.0, "force along x in the first step", "N")
    start: float = param(1.0, "u0 at theta, the force along y in the first step", "N")

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return the balls at rest on the x axis, centres 0.175 m apart."""
        return self.at_rest(xp, theta, -0.375, 0.0, -0.2, 0.0)

    def planned_controls(self, xp: Any, theta: Array) -> Array:
        """Return (push, u0) in the first step and 0 afterwards."""
        return self.in_first_step(xp, xp.stack([0.0 * theta[0] + self.push, theta[0]]))

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return xp.concat([u / self.mass, 0.0 * u], axis=0)

    def gap(self, xp: Any, q: Array) -> Array:
        return _distance(xp, q)[None] - 2.0 * self.radius

    def gap_rate(self, xp: Any, q: Array, v: Array) -> Array:
        apart, relative = q[2:4] - q[0:2], v[2:4] - v[0:2]
        return (xp.sum(apart * relative, axis=0) / _distance(xp, q))[None]

    def contact_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        normal = (q[2:4] - q[0:2]) / _distance(xp, q)
        pushed = normal * force / self.mass
        return xp.concat([-pushed, pushed], axis=0)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return q[2] ** 2 + q[3] ** 2


def _distance(xp: Any, q: Array) -> Array:
    """Return the distance between the centres, ``(B,)``."""
    return xp.sqrt((q[2] - q[0]) ** 2 + (q[3] - q[1]) ** 2)
