"""Running on one leg from random starts, under a neural policy."""

import math
from dataclasses import dataclass
from typing import Any

from bench.model import Array, FrictionScene, PolicyScene, State, param, uniform

from .axis_contact import AxisContactScene

LEAN = math.pi / 6
"""Pitch at which the reward for an upright body is 0 [rad] (Xu et al. 2022)."""


@dataclass(frozen=True)
class HopperRun(PolicyScene, AxisContactScene, FrictionScene):
    """A planar body on one springy leg with a point foot runs forward (after Thompson and Raibert 1990).

    q = (x, z, pitch) of the body and (x, z) of the foot. The leg joins the body's centre to the foot. With its length l
    and its angle a from straight down, positive forward, it pushes both apart with k (rest length - l) - b l' +
    ``thrust`` tanh(u_0). The hip turns the leg forward with the torque ``torque`` tanh(u_1) - k_h (a - pitch), and the
    body with the opposite one. Positive pitch leans backward. The foot meets the ground with Coulomb friction. An
    episode ends when the body is below ``low`` or its pitch beyond ``tilt``; the step in which this happens changes
    with theta, so f has jumps.

    f = minus the sum of x' + h + 1 - (pitch / 30 deg)^2 - ``effort`` |tanh u|^2 over the states before each step. The
    height term h is d = z - low - ``margin`` up to 0.3 m, and -200 d^2 for negative d. These are the terms of Xu et al.
    2022 for their hopper (arXiv 2204.07137, appendix), with lengths of this body. It starts in the air with its foot up
    to 0.2 m above the ground, pitch and leg angle in +-0.1, x' and z' in +-0.5 m/s, each uniform.
    Observation (z, l - rest length, foot's z, pitch, a - pitch, and the rates z', l', x', pitch', a' - pitch').
    """

    name = "hopper_run"
    neglected_effects = "size of the foot, end stops, the leg's own mass, speed limits of the actuators"
    continuous = False
    n_q = 5
    n_u = 2
    gap_axis = 4
    slip_axis = 3
    contact_mass = "foot_mass"
    n_observations = 10
    exogenous = 10
    contact_values = {"stiffness": 1e4}

    sigma: float = param(0.3, "standard deviation of the noise on each action, or on each parameter", positive=True)
    horizon: int = 240
    dt: float = 1 / 60
    substeps: int = 8
    restitution: float = 0.0
    friction: float = param(0.9, "Coulomb coefficient of the foot under a force law", low=0.0)
    slip_speed: float = 0.3
    body_mass: float = param(4.0, "mass of the body", "kg", positive=True)
    inertia: float = param(0.3, "moment of inertia of the body", "kg m^2", positive=True)
    foot_mass: float = param(0.5, "mass of the foot", "kg", positive=True)
    leg: float = param(0.5, "rest length of the leg", "m", positive=True)
    leg_stiffness: float = param(1500.0, "k, stiffness of the leg", "N/m", positive=True)
    leg_damping: float = param(15.0, "b, damping of the leg", "N s/m", low=0.0)
    hip_stiffness: float = param(10.0, "k_h, stiffness of the hip", "N m/rad", low=0.0)
    gravity: float = param(9.81, "g", "m/s^2")
    thrust: float = param(80.0, "largest force of the leg's actuator", "N", positive=True)
    torque: float = param(10.0, "largest torque of the hip's actuator", "N m", positive=True)
    effort: float = param(0.1, "weight of the squared actions", low=0.0)
    low: float = param(0.2, "height of the body at which an episode ends", "m", positive=True)
    margin: float = param(0.1, "height above low from which height is rewarded", "m", low=0.0)
    tilt: float = param(1.2, "pitch at which an episode ends", "rad", positive=True)

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return the state at rest and upright, with the foot 0.1 m above the ground."""
        return self.at_rest(xp, theta, 0.0, 0.1 + self.leg, 0.0, 0.0, 0.1)

    def random_start(self, xp: Any, e: Array) -> State:
        u = uniform(xp, e)
        zero, foot, angle = 0.0 * u[0], 0.2 * u[0], 0.2 * u[1] - 0.1
        q = [zero, foot + self.leg * xp.cos(angle), 0.2 * u[2] - 0.1, self.leg * xp.sin(angle), foot]
        forward, upward = u[3] - 0.5, u[4] - 0.5
        return State(xp.stack(q), xp.stack([forward, upward, zero, forward, upward]))

    def observation(self, xp: Any, q: Array, v: Array) -> Array:
        length, angle, _, (stretching, across) = self._leg(xp, q, v)
        return xp.stack(
            [
                q[1],
                length - self.leg,
                q[4],
                q[2],
                angle - q[2],
                v[1],
                stretching,
                v[0],
                v[2],
                across / length - v[2],
            ]
        )

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        length, angle, (x, z), (stretching, _) = self._leg(xp, q, v)
        push = self.leg_stiffness * (self.leg - length) - self.leg_damping * stretching + self.thrust * xp.tanh(u[0])
        turn = self.torque * xp.tanh(u[1]) - self.hip_stiffness * (angle - q[2])
        # the force on the foot: push along the leg, and the hip's torque over the length across it
        across = turn / length
        force_x, force_z = push * x - across * z, push * z + across * x
        return xp.stack(
            [
                -force_x / self.body_mass,
                -force_z / self.body_mass - self.gravity,
                -turn / self.inertia,
                force_x / self.foot_mass,
                force_z / self.foot_mass - self.gravity,
            ]
        )

    def has_ended(self, xp: Any, q: Array, v: Array) -> Array:
        return (q[1] < self.low) | (xp.abs(q[2]) > self.tilt)

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Return minus the reward of one step, 0 after the end."""
        d = q[1] - self.low - self.margin
        # height above the free zone up to which the reward grows [m] (Xu et al. 2022)
        # weight of the squared depth below the free zone [1/m^2] (Xu et al. 2022)
        height = xp.where(d > 0, xp.clip(d, 0.0, 0.3), -200.0 * d * d)
        effort = self.effort * (xp.tanh(u[0]) ** 2 + xp.tanh(u[1]) ** 2)
        reward = v[0] + height + 1.0 - (q[2] / LEAN) ** 2 - effort
        return xp.where(self.has_ended(xp, q, v), 0.0 * reward, -reward)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return 0.0 * q[0]

    def _leg(self, xp: Any, q: Array, v: Array) -> tuple[Array, Array, tuple[Array, Array], tuple[Array, Array]]:
        """Return the leg's length, angle, direction, and the foot's velocity from the body along and across it."""
        x, z, v_x, v_z = q[3] - q[0], q[4] - q[1], v[3] - v[0], v[4] - v[1]
        length = xp.sqrt(x**2 + z**2)
        x, z, angle = x / length, z / length, xp.atan2(x, -z)
        return length, angle, (x, z), (x * v_x + z * v_z, x * v_z - z * v_x)
