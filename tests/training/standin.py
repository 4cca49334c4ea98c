"""A stand-in for the contract of policy problems, and the cart-pole of OPTIMISE section 7."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.model import MechanicalScene, Rollout, State, param


@dataclass(frozen=True)
class PolicyScene(MechanicalScene):
    n_observations: ClassVar[int]
    n_start: ClassVar[int]
    substeps: int = param(4, "integrator steps per control step", positive=True)
    discount: float = param(0.99, "discount", positive=True)

    def theta0(self):
        return np.zeros(1)

    def initial_state(self, xp, theta):
        raise NotImplementedError

    def has_ended(self, xp, q, v):
        return xp.zeros(q.shape[1], dtype=bool)

    def terminal_cost(self, xp, q, v):
        return 0.0 * v[0]


class PolicyRollout(Rollout):
    def step(self, ops, state, u):
        for _ in range(self.scene.substeps):
            state = super().step(ops, state, u)
        return state


def uniform(xp, e):
    return xp.exp(-(e[0] ** 2 + e[1] ** 2) / 2)


@dataclass(frozen=True)
class CartpoleSwing(PolicyScene):
    name = "cartpole_swing"
    n_q: ClassVar[int] = 2
    n_u: ClassVar[int] = 1
    n_observations: ClassVar[int] = 5
    n_start: ClassVar[int] = 8
    horizon: int = param(240, "steps")
    dt: float = param(1 / 240, "")

    def random_start(self, xp, e):
        u = [uniform(xp, e[2 * i : 2 * i + 2]) - 0.5 for i in range(4)]
        return State(xp.stack([math.pi * u[0], -math.pi + math.pi * u[1]]), xp.stack([0.5 * u[2], 0.5 * u[3]]))

    def observation(self, xp, q, v):
        return xp.stack([q[0], v[0], xp.sin(q[1]), xp.cos(q[1]), v[1]])

    def acceleration(self, xp, q, v, u):
        m, M, half, g = 0.1, 1.0, 0.5, 9.81
        f = 10.0 * xp.tanh(u[0])
        s, c = xp.sin(q[1]), xp.cos(q[1])
        temp = (f + m * half * v[1] ** 2 * s) / (m + M)
        thacc = (g * s - c * temp) / (half * (4 / 3 - m * c**2 / (m + M)))
        xacc = temp - m * half * thacc * c / (m + M)
        return xp.stack([xacc, thacc])

    def stage_cost(self, xp, q, v, u):
        a = xp.atan2(xp.sin(q[1]), xp.cos(q[1]))
        return a**2 + 0.1 * v[1] ** 2 + 0.05 * q[0] ** 2 + 0.1 * v[0] ** 2


def cartpole_program(**kw):
    from bench.model import registry

    return PolicyRollout(CartpoleSwing(**kw), None, registry.make("integrators", "semi_implicit_euler"))


from bench.model import ContactScene  # noqa: E402


@dataclass(frozen=True)
class Pressed(PolicyScene, ContactScene):
    """A mass that a policy presses onto the ground: q is its height [m]."""

    name = "pressed"
    n_q: ClassVar[int] = 1
    n_u: ClassVar[int] = 1
    n_contacts: ClassVar[int] = 1
    n_observations: ClassVar[int] = 2
    n_start: ClassVar[int] = 2
    horizon: int = param(20, "steps")
    dt: float = param(0.01, "")
    substeps: int = param(1, "")

    def random_start(self, xp, e):
        return State(0.05 + 0.02 * uniform(xp, e)[None], 0.0 * e[:1])

    def observation(self, xp, q, v):
        return xp.concat([q, v], axis=0)

    def acceleration(self, xp, q, v, u):
        return u - 9.81

    def gap(self, xp, q):
        return q

    def gap_rate(self, xp, q, v):
        return v

    def contact_acceleration(self, xp, q, force):
        return force

    def stage_cost(self, xp, q, v, u):
        return (q[0] + 0.01) ** 2


def pressed_program(contact="penalty", **contact_parameters):
    from bench.model import registry

    law = registry.make("contacts", contact, contact_parameters)
    return PolicyRollout(Pressed(), law, registry.make("integrators", "semi_implicit_euler"))
