"""One ball is pushed so that it strikes another into a goal: control through a collision."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, ContactScene, ImpulseLaw, KnownOptimum, OpenLoopScene, Plugin, State, param


@dataclass(frozen=True)
class TwoBalls(KnownOptimum, OpenLoopScene, ContactScene):
    """Two equal balls on a table without friction; q = (x1, y1, x2, y2), a force on the first moves both.

    theta holds the two forces of each step (d = 2 horizon), at first (3, 3) throughout. f = squared distance of the
    second ball from (0, 0) at the end plus ``effort`` dt sum |u|^2. The balls start at (-2, -2) and (-1, -1) on the
    goal's diagonal and collide elastically.

    By symmetry the optimum is a push along the diagonal: with the impact at time s and speed v per coordinate, and d
    the gap per coordinate, f(s, v) = (8 effort / s + 2 (T - s)^2) v^2 - (4 (T - s) + 24 effort d / s^2) v + 2 + 24
    effort d^2 / s^3, so s* = .68322, J* = 1.396542 at the default effort for dt -> 0. Doing nothing costs 2. Without
    the time of impact the gradient of the collision has the wrong sign, and descent learns to do nothing. Source:
    Zhong, Han, Brikis 2022, task 3, which has 480 steps.
    """

    name = "two_balls"
    theta_names = ("force", "force")
    continuous = True
    neglected_effects = "spin, friction, the table's edges, further balls"
    n_q = 4
    n_u = 2
    n_contacts = 1

    sigma: float = param(0.1, "standard deviation of the noise on each force", "N", positive=True)
    horizon: int = 120
    dt: float = 1 / 120
    radius: float = param(0.2, "radius of both balls", "m", positive=True)
    force: float = param(3.0, "both components of the force of every step at theta", "N")
    effort: float = param(0.1, "weight of the squared force", "m^2/(N^2 s)", positive=True)

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return the balls at rest at (-2, -2) and (-1, -1)."""
        return self.at_rest(xp, theta, -2.0, -2.0, -1.0, -1.0)

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Return the force on the first ball; both have a mass of 1 kg."""
        return xp.stack([u[0], u[1], 0.0 * u[0], 0.0 * u[0]])

    def gap(self, xp: Any, q: Array) -> Array:
        return xp.sqrt((q[2:3] - q[0:1]) ** 2 + (q[3:4] - q[1:2]) ** 2) - 2.0 * self.radius

    def gap_rate(self, xp: Any, q: Array, v: Array) -> Array:
        x, y = self._normal(xp, q)
        return x * (v[2:3] - v[0:1]) + y * (v[3:4] - v[1:2])

    def contact_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        x, y = self._normal(xp, q)
        return xp.concat([-x * force, -y * force, x * force, y * force])

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return self.effort * self.dt * (u[0] ** 2 + u[1] ** 2)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return q[2] ** 2 + q[3] ** 2

    def optimum(self, contact: ContactLaw | None, integrator: Plugin | None) -> tuple[float, str] | None:
        """Return the minimum of f(s, v) by grid search over the impact time s, or 2 if no push reduces the cost.

        None unless the law is an impulse law with restitution 1.
        """
        if not isinstance(contact, ImpulseLaw) or self.restitution != 1.0:
            return None
        end, gap, eps = self.horizon * self.dt, 1.0 - math.sqrt(2.0) * self.radius, self.effort
        s = np.linspace(1e-3, 1.0 - 1e-9, 100_001) * end
        for _ in range(6):
            bend = 8 * eps / s + 2 * (end - s) ** 2
            slope = 4 * (end - s) + 24 * eps * gap / s**2
            cost = 2 + 24 * eps * gap**2 / s**3 - slope**2 / (4 * bend)
            best = int(np.argmin(cost))
            s = np.linspace(s[max(best - 1, 0)], s[min(best + 1, s.size - 1)], 1001)
        return min(2.0, float(cost[best])), "grid search over the impact time, for dt -> 0"

    def _normal(self, xp: Any, q: Array) -> tuple[Array, Array]:
        """Return the direction from the first centre to the second."""
        x, y = q[2:3] - q[0:1], q[3:4] - q[1:2]
        length = xp.sqrt(x * x + y * y)
        return x / length, y / length
