"""Policy problems of the tests: cart-pole, and a mass that a policy presses onto the ground."""

from dataclasses import dataclass
from typing import ClassVar

from classes import CartpoleSwing, SemiImplicitEuler

from bench.model import ContactScene, State, compose, param, registry
from bench.model.policy import PolicyScene, uniform
from bench.training.environment import Environment


def cartpole_program(**parameters):
    """Return the program of cart-pole with semi-implicit Euler."""
    return compose(CartpoleSwing(**parameters), None, SemiImplicitEuler())


@dataclass(frozen=True)
class Pressed(PolicyScene, ContactScene):
    """A mass of 1 kg that a policy presses onto the ground: q is its height [m]."""

    name = "pressed"
    n_q: ClassVar[int] = 1
    n_u: ClassVar[int] = 1
    n_contacts: ClassVar[int] = 1
    n_observations: ClassVar[int] = 2
    exogenous: ClassVar[int] = 2

    horizon: int = param(20, "control steps", "steps", positive=True)
    dt: float = param(0.01, "length of a control step", "s", positive=True)

    def initial_state(self, xp, theta):
        return State(0.05 + 0.0 * theta[:1], 0.0 * theta[:1])

    def random_start(self, xp, e):
        return State(0.05 + 0.02 * uniform(xp, e), 0.0 * e[:1])

    def observation(self, xp, q, v):
        return xp.stack([q[0], v[0]])

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

    def terminal_cost(self, xp, q, v):
        return 0.0 * q[0]


@dataclass(frozen=True)
class Untouched(Pressed):
    """The same mass, which the policy does not move; each step costs the squared distance of the action from its height."""

    name = "untouched"

    def acceleration(self, xp, q, v, u):
        return 0.0 * u

    def stage_cost(self, xp, q, v, u):
        return (u[0] - q[0]) ** 2


def pressed_program(contact="penalty", scene=None, **parameters):
    """Return the program of the pressed mass, or of another scene with a contact, under a contact law."""
    return compose(scene or Pressed(), registry.make("contacts", contact, parameters), SemiImplicitEuler())


def environment(program, backend="jax", dtype="float64"):
    """Return the episodes of a program with the operations of a backend."""
    return Environment(program, registry.make("backends", backend).ops(), dtype)
