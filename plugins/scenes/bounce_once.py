"""One elastic bounce without gravity: the smallest test of a contact gradient."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.model import Array, ContactLaw, EngineTwin, ImpulseLaw, Plugin, State, param

from .axis_contact import AxisContactScene


@dataclass(frozen=True)
class BounceOnce(EngineTwin, AxisContactScene):
    """A ball flies at constant speed to the ground and back; q is the height of its centre.

    State (q, v); theta = (y0, vy0, u0), initial height and velocity and a vertical force during the first step only,
    with parameter noise; f = q_T. A rigid bounce ends at radius + restitution |z| with
    z = y0 - radius + T (vy0 + dt u0 / mass). With the default height, contact begins in the middle of a step. With
    the source's height of 1 it begins on the boundary between two steps, a kink of the penalty program.
    Source: Zhong, Han, Brikis 2022, task 1.
    """

    name = "bounce_once"
    theta_names = ("height", "velocity", "force")
    continuous = True
    neglected_effects = "the horizontal motion (free, uncoupled), gravity, spin"
    n_q = 1
    n_u = 1
    contact_values = {"stiffness": 1e4, "damping": 0.0}

    sigma: float = param(0.1, "standard deviation of the noise on theta", "m, m/s and N", positive=True)
    horizon: int = 480
    dt: float = 1.0 / 480.0
    mass: float = param(1.0, "mass of the ball", "kg", positive=True)
    radius: float = param(0.1, "radius of the ball", "m", positive=True)
    height: float = param(1.0 + 1.0 / 480.0, "initial height of the centre at theta", "m", positive=True)
    velocity: float = param(-2.0, "initial velocity at theta, upwards", "m/s")
    force: float = param(0.0, "force during the first step at theta, upwards", "N")

    def initial_state(self, xp: Any, theta: Array) -> State:
        return State(theta[0:1], theta[1:2])

    def planned_controls(self, xp: Any, theta: Array) -> Array:
        """Return the force in the first step and 0 afterwards."""
        return self.in_first_step(xp, theta[2:3])

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return u / self.mass

    def gap(self, xp: Any, q: Array) -> Array:
        return q - self.radius

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return q[0]

    def mjcf(self) -> str:
        return f"""
            <worldbody>
              <geom name="ground" type="plane" size="1 1 1"/>
              <body>
                <joint name="height" type="slide" axis="0 0 1"/>
                <geom name="ball" type="sphere" size="{self.radius}" mass="{self.mass}"/>
              </body>
            </worldbody>
            <contact><pair geom1="ground" geom2="ball" condim="1"/></contact>
            <actuator><motor joint="height"/></actuator>"""

    def closed_form_gradient(self, contact: ContactLaw | None, integrator: Plugin | None) -> np.ndarray | None:
        """Return (P(z > 0) - restitution P(z < 0)) dz/dtheta, z normal; None without impulses at the time of impact.

        This assumes that no sample starts inside the ground, which is 9 standard deviations away with the default
        theta.
        """
        is_semi_implicit = getattr(integrator, "moves_with", "") == "new"
        if not (is_semi_implicit and isinstance(contact, ImpulseLaw) and contact.finds_time_of_impact()):
            return None
        slope = self._free_slope()
        spread = self.sigma * float(np.linalg.norm(slope))
        above = 0.5 * math.erfc(-self._free_end() / (math.sqrt(2) * spread))
        return (above - self.restitution * (1.0 - above)) * slope

    def physical_gradient(self) -> np.ndarray:
        """Return -restitution (1, T, T dt / mass) after a rigid bounce, (1, T, T dt / mass) without."""
        return self._free_slope() * (1.0 if self._free_end() > 0 else -self.restitution)

    def physical_cost(self) -> float:
        """Return radius + z, or radius - restitution z after a rigid bounce."""
        end = self._free_end()
        return self.radius + (end if end > 0 else -self.restitution * end)

    def _free_end(self) -> float:
        """Return z, the final gap without a ground."""
        return self.height - self.radius + self.horizon * self.dt * (self.velocity + self.dt * self.force / self.mass)

    def _free_slope(self) -> np.ndarray:
        """Return dz / dtheta."""
        end = self.horizon * self.dt
        return np.array([1.0, end, end * self.dt / self.mass])
