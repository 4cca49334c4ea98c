"""Swinging up a pole on a cart from random starts, under a neural policy."""

import math
from dataclasses import dataclass
from typing import Any

from bench.model import Array, PolicyScene, State, param, uniform


@dataclass(frozen=True)
class CartpoleSwing(PolicyScene):
    """A uniform pole of length 2 l on a cart, with a force of at most ``force`` N: F = force tanh(u).

    State (x, a, x', a') with the angle a from upright. The pole starts near hanging: x and a + pi are uniform in
    +-pi/2, x' and a' in +-1/4. With s = sin a, c = cos a and M the total mass, the usual equations of the cart-pole
    hold: a'' = (g s - c k) / (l (4/3 - m c^2 / M)) with k = (F + m l a'^2 s) / M, and x'' = k - m l a'' c / M.
    f = sum of a^2 + 0.1 a'^2 + 0.05 x^2 + 0.1 x'^2 over the states before each step, with a wrapped to +-pi: minus the
    return of the public cart-pole settings of Xu et al. 2022 (arXiv 2204.07137), whose time step, substeps and episode
    length are the defaults. Observation (x, x', s, c, a').
    """

    name = "cartpole_swing"
    neglected_effects = "the track's ends, friction"
    continuous = True
    n_q = 2
    n_u = 1
    n_observations = 5
    exogenous = 8

    sigma: float = param(0.3, "standard deviation of the noise on each action, or on each parameter", positive=True)
    horizon: int = 240
    dt: float = 1 / 60
    substeps: int = 4
    cart_mass: float = param(1.0, "mass of the cart", "kg", positive=True)
    pole_mass: float = param(0.1, "m, mass of the pole", "kg", positive=True)
    length: float = param(0.5, "l, half the length of the pole", "m", positive=True)
    gravity: float = param(9.81, "g", "m/s^2")
    force: float = param(10.0, "largest force on the cart", "N", positive=True)

    def initial_state(self, xp: Any, theta: Array) -> State:
        return self.at_rest(xp, theta, 0.0, -math.pi)

    def random_start(self, xp: Any, e: Array) -> State:
        u = uniform(xp, e) - 0.5
        return State(xp.stack([math.pi * u[0], math.pi * u[1] - math.pi]), 0.5 * u[2:4])

    def observation(self, xp: Any, q: Array, v: Array) -> Array:
        """Return (x, x', sin a, cos a, a')."""
        return xp.stack([q[0], v[0], xp.sin(q[1]), xp.cos(q[1]), v[1]])

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        sine, cosine, mass = xp.sin(q[1]), xp.cos(q[1]), self.cart_mass + self.pole_mass
        moment = self.pole_mass * self.length
        pushed = (self.force * xp.tanh(u[0]) + moment * v[1] * v[1] * sine) / mass
        turn = (self.gravity * sine - cosine * pushed) / (
            self.length * (4.0 / 3.0 - self.pole_mass * cosine * cosine / mass)
        )
        return xp.stack([pushed - moment * turn * cosine / mass, turn])

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        angle = xp.atan2(xp.sin(q[1]), xp.cos(q[1]))
        return angle**2 + 0.1 * v[1] ** 2 + 0.05 * q[0] ** 2 + 0.1 * v[0] ** 2

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        return 0.0 * q[0]
