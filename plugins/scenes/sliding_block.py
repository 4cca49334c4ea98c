"""A block that slides to rest: the friction identified from its distance depends on the time step."""

from dataclasses import dataclass
from typing import Any

from bench.model import Array, Identified, MechanicalScene, State, param


@dataclass(frozen=True)
class SlidingBlock(Identified, MechanicalScene):
    """x'' = -friction g until the block stops; f = (x_T - goal)^2. theta is the initial speed, with parameter noise.

    By default it slides d = v0^2 / (2 friction g) = 1.529052 m, with dd/dfriction = -5.096840. A step ends at speed 0
    if the block would turn back, which shortens d by dt v0 / 2: a friction fitted to the true d is too low by the
    factor 1 - dt friction g / v0 and valid for its time step only. A stopped block remains at rest.
    """

    name = "sliding_block"
    theta_names = ("speed",)
    neglected_effects = "a higher coefficient at rest, friction that changes with speed"
    continuous = True
    n_q = 1
    unknowns = ("friction",)
    end_only = True

    sigma: float = param(0.1, "standard deviation of the noise on the speed", "m/s", positive=True)
    horizon: int = 60
    dt: float = 0.02
    friction: float = param(0.3, "Coulomb coefficient", positive=True)
    gravity: float = param(9.81, "g", "m/s^2", positive=True)
    speed: float = param(3.0, "v0, at theta", "m/s", positive=True)
    goal: float = param(2.0, "target x at the end", "m")

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return position 0 and the speed in theta."""
        return State(0.0 * theta[:1], theta[:1])

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        most, stop = self.friction * self.gravity, v / self.dt
        return -xp.where(stop < most, stop, most + 0.0 * v)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return (q[0] - self.goal) ** 2
