"""A puck pushed along a table that ends: it drops to the floor beyond the edge."""

from dataclasses import dataclass

import numpy as np

from bench.plugin import MechanicalScene, State, param


@dataclass(frozen=True)
class TableEdge(MechanicalScene):
    """A puck slides with viscous drag from x = 0 at speed theta; beyond the table's edge it falls 1 m to the floor; f = (x - goal)^2 + height lost."""

    name = "table_edge"
    neglected_effects = "bounces on the floor"
    n_q = 2
    sigma: float = param(0.2, "noise on the speed", "m/s", positive=True)
    horizon: int = param(100, "steps", "steps", positive=True)
    dt: float = param(0.01, "step", "s", positive=True)
    edge: float = param(1.4, "edge", "m")
    loss: float = param(1.0, "cost of being off the table")
    speed: float = param(2.0, "speed at theta", "m/s")
    goal: float = param(2.0, "goal", "m")

    def theta0(self):
        return np.array([self.speed])

    def initial_state(self, xp, theta):
        zero = 0.0 * theta[0:1]
        return State(xp.concat([zero, zero + 1.0]), xp.concat([theta[0:1], zero]))

    def acceleration(self, xp, q, v, u):
        return xp.stack([-1.0 * v[0], 0.0 * v[1]])

    def terminal_cost(self, xp, q, v):
        return (q[0] - self.goal) ** 2 + xp.where(q[0] > self.edge, self.loss + 0.0 * q[0], 0.0 * q[0])
