"""The running hopper in flight; ``test_integrators.py`` has its energy."""

import numpy as np
import pytest

import bench
from bench.model import LoopOps, State

EXACT = 1e-12
"""Relative rounding error of a few hundred steps in float64."""


def momentum(scene, state):
    """Return total angular momentum about the centre of mass, positive as the leg swings forward."""
    (x, z, _, foot_x, foot_z), (v_x, v_z, spin, w_x, w_z) = state.q[:, 0], state.v[:, 0]
    reduced = scene.body_mass * scene.foot_mass / (scene.body_mass + scene.foot_mass)
    return scene.inertia * spin + reduced * ((foot_x - x) * (w_z - v_z) - (foot_z - z) * (w_x - v_x))


def test_flight_is_a_parabola_and_conserves_angular_momentum_under_any_actions():
    program = bench.problem("hopper_run", backend="numpy").program
    scene = program.scene
    first = State(np.array([[0.0], [2.5], [-0.2], [0.15], [2.0]]), np.array([[1.0], [0.0], [0.5], [1.0], [0.0]]))
    states = [first]
    for t in range(20):
        states.append(program.step(LoopOps(), states[-1], np.array([[np.sin(t)], [np.cos(2 * t)]])))
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
