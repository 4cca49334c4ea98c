"""The running hopper: conserved quantities, rest on the ground, rewards, and gradients around touch-down."""

import jax
import numpy as np
import pytest

from bench.model import State, compose, registry
from bench.model.ops import LoopOps

jax.config.update("jax_enable_x64", True)

EXACT = 1e-12
"""Relative rounding error of a few hundred steps in float64."""


def program_of(contact="penalty", law=None, **parameters):
    scene = registry.make("scenes", "hopper_run", parameters)
    law = registry.make("contacts", contact, {"stiffness": 1e4} | (law or {}))
    return compose(scene, law, registry.make("integrators", "semi_implicit_euler"))


def start_of(*, foot=0.1, speed=0.0, fall=0.0, angle=0.0, pitch=0.0, spin=0.0):
    """Return one state with the leg at its rest length."""
    q = [0.0, foot + 0.5 * np.cos(angle), pitch, 0.5 * np.sin(angle), foot]
    return State(np.array(q)[:, None], np.array([speed, -fall, spin, speed, -fall])[:, None])


def steps(program, state, count, u=0.0):
    """Return the states before and after each of ``count`` control steps; ``u`` is a number or a function of the step."""
    states = [state]
    for t in range(count):
        value = u(t) if callable(u) else u
        states.append(program.step(LoopOps(), states[-1], np.zeros((2, 1)) + value))
    return states


def momentum(scene, state):
    """Return total angular momentum about the centre of mass, positive as the leg swings forward."""
    (x, z, _, foot_x, foot_z), (v_x, v_z, spin, w_x, w_z) = state.q[:, 0], state.v[:, 0]
    reduced = scene.body_mass * scene.foot_mass / (scene.body_mass + scene.foot_mass)
    return scene.inertia * spin + reduced * ((foot_x - x) * (w_z - v_z) - (foot_z - z) * (w_x - v_x))


def test_flight_is_a_parabola_and_conserves_angular_momentum_under_any_actions():
    program = program_of()
    scene = program.scene
    first = start_of(foot=2.0, speed=1.0, angle=0.3, pitch=-0.2, spin=0.5)
    states = steps(program, first, 20, u=lambda t: np.array([[np.sin(t)], [np.cos(2 * t)]]))
    assert min(state.q[4, 0] for state in states) > 0
    share = scene.foot_mass / (scene.body_mass + scene.foot_mass)
    n = 20 * scene.substeps
    h = scene.dt / scene.substeps
    for axis, fall in ((0, 0.0), (1, scene.gravity * h * h * n * (n + 1) / 2)):
        centre = [(1 - share) * s.q[axis, 0] + share * s.q[axis + 3, 0] for s in states]
        speed = first.v[axis, 0]
        assert centre[-1] == pytest.approx(centre[0] + n * h * speed - fall, rel=EXACT)
    assert momentum(scene, states[-1]) == pytest.approx(momentum(scene, first), rel=1e3 * EXACT)
    assert abs(states[-1].v[2, 0] - 0.5) > 0.1  # the actions do turn the body
