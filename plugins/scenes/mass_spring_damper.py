"""A mass on a spring and a damper, released from rest: identifiable and unidentifiable parameters."""

from dataclasses import dataclass
from typing import Any

from bench.model import Array, Identified, MechanicalScene, State, param


@dataclass(frozen=True)
class MassSpringDamper(Identified, MechanicalScene):
    """m x'' = -k x - c x' + ``force`` sin t from rest at ``start``; f = mean of (x - hold)^2 over the steps.

    theta is the position at the start, with parameter noise. Without a force the motion is x = e^(-at) (cos wt + (a/w)
    sin wt) with a = c / 2m and w^2 = k/m - a^2: it depends on k/m and c/m only, so that m, k and c are not identifiable
    separately. With a known force they are.
    """

    name = "mass_spring_damper"
    theta_names = ("start",)
    neglected_effects = "dry friction, nonlinear stiffness"
    continuous = True
    n_q = 1
    n_u = 1
    unknowns = ("mass", "stiffness", "damping")

    sigma: float = param(0.1, "standard deviation of the noise on theta", "m", positive=True)
    horizon: int = 200
    dt: float = 0.05
    mass: float = param(1.0, "m", "kg", positive=True)
    stiffness: float = param(4.0, "k", "N/m", low=0.0)
    damping: float = param(0.4, "c", "N s/m", low=0.0)
    force: float = param(0.0, "amplitude of the force sin t", "N")
    start: float = param(1.0, "x at the start, at theta", "m")
    hold: float = param(0.0, "target x", "m")

    def initial_state(self, xp: Any, theta: Array) -> State:
        return State(theta[:1], 0.0 * theta[:1])

    def planned_controls(self, xp: Any, theta: Array) -> Array:
        """Return sin t at the middle of each step, independent of theta, ``(horizon, 1, B)``."""
        time = self.dt * (xp.astype(xp.arange(self.horizon), theta.dtype)[:, None] + 0.5)
        return (xp.sin(time) + 0.0 * theta[0])[:, None, :]

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return (self.force * u - self.stiffness * q - self.damping * v) / self.mass

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return (q[0] - self.hold) ** 2 / self.horizon

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return 0.0 * q[0]
