"""A block dragged through stick and slip."""

from dataclasses import dataclass
from typing import Any

from bench.model import Array, FrictionScene, State, param

from .axis_contact import AxisContactScene


@dataclass(frozen=True)
class FrictionBlock(AxisContactScene, FrictionScene):
    """A block on the ground is dragged by a spring whose other end is pulled in jerks; q = (x, z).

    The spring's end is at p(t) = V (t - a sin(w t) / w): its mean speed is V, and for a = 1 it is at rest once per
    period 2 pi / w; for a = 0 its speed is constant. theta = (V, a), with parameter noise; f = half the squared
    distance of the block's final position from (goal, 0).

    The contact law computes the normal force lambda. The block starts at the depth that balances its weight under the
    scene's stiffness. Friction is regularised Coulomb, mu lambda tanh(slip / slip_speed), so that a sticking block
    creeps. The coefficient is the same for stick and slip: the block sticks until the spring pulls with mu m g and then
    moves at V (1 - cos(sqrt(k/m) t)), at rest only for moments. Longer sticking would need a coefficient that decreases
    with speed. Explicit steps are stable up to dt mu g < 2 slip_speed. Impulse laws have no friction, so that the block
    slides freely.
    """

    name = "friction_block"
    theta_names = ("pull", "jerk")
    continuous = True
    neglected_effects = "rotation and shape, a higher coefficient at rest, the second horizontal direction"
    n_q = 2
    n_u = 1
    gap_axis = 1
    slip_axis = 0
    contact_values = {"stiffness": 1e5, "beta": 1e5}

    sigma: float = param(0.02, "standard deviation of the noise on V and a", "m/s and 1", positive=True)
    horizon: int = 1500
    dt: float = 0.001
    mass: float = param(1.0, "m", "kg", positive=True)
    gravity: float = param(9.81, "g", "m/s^2", positive=True)
    friction: float = param(0.5, "mu, Coulomb coefficient", low=0.0)
    slip_speed: float = 0.005
    spring: float = param(400.0, "k, stiffness of the spring", "N/m", positive=True)
    depth: float = param(9.81e-5, "penetration at the start", "m", low=0.0)
    pull: float = param(0.3, "V at theta", "m/s")
    jerk: float = param(1.0, "a at theta: amplitude of the end's speed over its mean")
    frequency: float = param(8.0, "w", "rad/s", positive=True)
    goal: float = param(1.0, "target x at the end", "m")
    restitution: float = 0.0

    def initial_state(self, xp: Any, theta: Array) -> State:
        return self.at_rest(xp, theta, 0.0, -self.depth)

    def planned_controls(self, xp: Any, theta: Array) -> Array:
        time = self.dt * xp.astype(xp.arange(self.horizon), theta.dtype)[:, None]
        return (theta[0] * (time - theta[1] * xp.sin(self.frequency * time) / self.frequency))[:, None, :]

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return xp.stack([self.spring * (u[0] - q[0]) / self.mass, 0.0 * v[1] - self.gravity])

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Return half the squared distance of the block from the goal on the ground."""
        return 0.5 * ((q[0] - self.goal) ** 2 + q[1] ** 2)
