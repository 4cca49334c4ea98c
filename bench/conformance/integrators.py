"""Checks of integrators on a smooth motion and on linear motions."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.conformance.kit import require, verifies
from bench.conformance.subjects import BareScene, NewtonOps, agree, distance
from bench.model import (
    Array,
    Contact,
    ContactScene,
    DampedScene,
    Dynamics,
    ImpulseLaw,
    Integrator,
    State,
    param,
)


@dataclass(frozen=True)
class _Swing(DampedScene, BareScene):
    """The motion q'' = -4 sin q - 0.2 v + u, smooth and without a closed form."""

    name = "conformance_swing"
    n_q = 1
    n_u = 1

    stiffness: float = param(4.0, "restoring acceleration at a right angle", "rad/s^2")
    friction: float = param(0.2, "deceleration per velocity", "1/s")

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return u - self.stiffness * xp.sin(q) - self.friction * v


@dataclass(frozen=True)
class _Kick(ImpulseLaw):
    """Adds 1 to the velocity and 0.1 to the position, regardless of the contact."""

    name = "conformance_kick"

    def impulse(self, ops: Any, contact: Contact, before: State, free: State, dt: Any) -> State:
        return State(0.0 * free.q + 0.1, 0.0 * free.v + 1.0)


@dataclass(frozen=True)
class _Kicked(_Swing, ContactScene):
    """The motion of :class:`_Swing`, with a contact."""

    n_contacts = 1

    def gap(self, xp: Any, q: Array) -> Array:
        return q

    def gap_rate(self, xp: Any, q: Array, v: Array) -> Array:
        return v

    def contact_acceleration(self, xp: Any, q: Array, force: Array) -> Array:
        return force


@dataclass(frozen=True)
class _Decay(BareScene):
    """The motion v' = rate v, without positions."""

    name = "conformance_decay"
    n_q = 0
    n_v = 1

    rate: float = param(-1.0, "growth rate", "1/s")

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return self.rate * v


@dataclass(frozen=True)
class _Oscillator(_Swing):
    """The motion q'' = -stiffness q - friction v."""

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        return -self.stiffness * q - self.friction * v


EXACT = 1e-9
"""Relative difference allowed between numbers that are equal up to rounding and a Newton tolerance of 1e-13."""


def _advance(integrator: Integrator, dynamics: Dynamics, steps: int, dt: float) -> State:
    state = State(np.array([[1.0, 0.3]]), np.array([[0.5, -1.0]]))
    for _ in range(steps):
        state = integrator.step(dynamics, state, np.full((1, 2), 0.3), dt)
    return state


@verifies(Integrator)
def error_falls_with_declared_order(integrator: Integrator) -> str:
    """Verify that the slope of log error against log dt is within 0.2 of ``order``, over 1 s of a smooth motion."""
    from scipy.integrate import solve_ivp

    scene = _Swing()

    def motion(t: float, y: np.ndarray) -> np.ndarray:
        q, v = y.reshape(2, 1, 2)
        return np.concatenate([v, scene.acceleration(np, q, v, np.full((1, 2), 0.3))]).ravel()

    exact = solve_ivp(motion, (0.0, 1.0), [1.0, 0.3, 0.5, -1.0], "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    steps = np.array([32, 64, 128])
    errors = []
    for n in steps:
        state = _advance(integrator, Dynamics(NewtonOps(), scene, None), n, 1.0 / n)
        errors.append(np.abs(np.concatenate(state).ravel() - exact).max())
    require(np.isfinite(errors).all() and min(errors) > 0, f"errors {errors}")
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    detail = f"slope {slope:.3f}, declared {integrator.order}"
    require(abs(slope - integrator.order) < 0.2, detail)
    return detail


@verifies(Integrator)
def amplification_is_that_of_the_step(integrator: Integrator) -> str:
    """Verify that one step on v' = a v multiplies v by ``amplification(a dt)``, for decay and growth, slow and stiff."""
    offs = []
    for dt, rate in itertools.product((0.01, 0.5), (-50.0, -3.0, 0.0, 0.7)):
        state = State(np.zeros((0, 1)), np.ones((1, 1)))
        end = integrator.step(Dynamics(NewtonOps(), _Decay(rate=rate), None), state, np.zeros((0, 1)), dt)
        require(end.q.shape == (0, 1), f"without positions, q becomes {end.q.shape}")
        stated = integrator.amplification(rate * dt)
        offs.append(abs(end.v[0, 0] - stated) / max(1.0, abs(stated)))
        detail = f"a dt = {rate * dt:g}: the step's factor is {end.v[0, 0]:.6g}, the stated one {stated:.6g}"
        require(offs[-1] < EXACT, detail)
    return f"to {max(offs):.0e} for a dt from -25 to 0.35"


@verifies(Integrator)
def transition_is_that_of_the_step(integrator: Integrator) -> str:
    """Verify ``transition`` against one step on q' = v, v' = -stiffness q - damping v, for two velocity factors.

    Without forces, v is multiplied by the factor, and q grows by dt v if the factor is 1.
    """
    offs = []
    for dt, stiffness, damping, factor in itertools.product((0.01, 0.3), (0.0, 4.0, 1e4), (0.0, 0.5, 20.0), (1.0, 0.6)):
        scene = _Oscillator(stiffness=stiffness, friction=damping, velocity_factor=factor)
        unit = State(np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]]))
        stepped = np.concatenate(integrator.step(Dynamics(NewtonOps(), scene, None), unit, np.zeros((1, 2)), dt))
        stated = integrator.transition(dt, stiffness, damping, factor)
        at = f"dt = {dt:g}, stiffness {stiffness:g}, damping {damping:g}, velocity factor {factor:g}"
        what = f"at {at} the step is {stepped.tolist()}, the stated matrix {stated.tolist()}"
        offs.append(agree(stepped, stated, EXACT, what))
        if not stiffness and not damping:
            free = np.array([[1.0, dt if factor == 1.0 else stepped[0, 1]], [0.0, factor]])
            agree(stepped, free, EXACT, f"without forces, {what}")
    return f"to {max(offs):.0e} in 36 settings"


@verifies(Integrator)
def takes_impulses_is_truthful(integrator: Integrator) -> str:
    """Verify that an impulse law changes the step if and only if the integrator declares ``takes_impulses``."""
    plain, kicked = (_advance(integrator, Dynamics(NewtonOps(), _Kicked(), law), 1, 0.01) for law in (None, _Kick()))
    change = np.array([np.abs(kicked.q - plain.q).max(), np.abs(kicked.v - plain.v).max()])
    if not integrator.takes_impulses:
        require(not change.any(), "applies impulses, but does not declare it")
        return "applies none"
    require(
        distance(change, np.array([0.11, 1.0])) < EXACT, f"an impulse of (0.1, 1) changes (q, v) by {change.tolist()}"
    )
    return "an impulse changes velocity, and position by dt times that and its own"


@verifies(Integrator)
def needs_root_of_integrator_is_truthful(integrator: Integrator) -> str:
    """Verify that the integrator solves an equation if and only if it declares ``needs_root``."""
    ops = NewtonOps()
    _advance(integrator, Dynamics(ops, _Swing(), None), 1, 0.01)
    require(
        bool(ops.solved) == integrator.needs_root,
        f"needs_root is {integrator.needs_root}, {ops.solved} equations solved",
    )
    return f"{ops.solved} equations per step"
