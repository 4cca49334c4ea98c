"""Integrators beyond the conformance kit: gradients across impacts, and energy."""

import dataclasses

import numpy as np
import pytest
from classes import (
    BouncingBall,
    CartpoleSwing,
    DoublePendulum,
    EventDriven,
    HopperRun,
    Impulse,
    Penalty,
    Torch,
)

from bench.model import Dynamics, LoopOps, compose


def test_event_driven_gradients_across_noise():
    """Each of 1,000 samples, among which impacts fall everywhere within a step."""
    scene = BouncingBall(horizon=100, dt=0.01)
    problem = Torch().compile(compose(scene, Impulse(), EventDriven()))
    w = np.random.default_rng(0).standard_normal((problem.program.n_noise, 1000))
    starts = scene.theta0()[:, None] + scene.sigma * w
    exact = [dataclasses.replace(scene, height=h, velocity=v).physical_gradient() for h, v in starts.T]
    assert problem.grad(scene.theta0(), w) == pytest.approx(np.transpose(exact), rel=1e-8, abs=1e-10)


# ------------------------------------------------------------------------------------------------------- energy


def cartpole_energy(scene, q, v):
    moment, total = scene.pole_mass * scene.length, scene.cart_mass + scene.pole_mass
    turning = moment * np.cos(q[1]) * v[0] * v[1] + 2 / 3 * moment * scene.length * v[1] ** 2
    return 0.5 * total * v[0] ** 2 + turning + moment * scene.gravity * np.cos(q[1])


def hopper_energy(scene, q, v):
    """With the energy of gravity, leg, hip and contact."""
    masses = np.array([scene.body_mass, scene.body_mass, scene.inertia, scene.foot_mass, scene.foot_mass])
    hip = np.arctan2(q[3] - q[0], q[1] - q[4]) - q[2]
    stretch = np.hypot(q[3] - q[0], q[4] - q[1]) - scene.leg
    springs = scene.leg_stiffness * stretch**2 + scene.hip_stiffness * hip**2 + STIFFNESS * np.minimum(q[4], 0.0) ** 2
    return 0.5 * (masses @ v**2 + springs) + scene.gravity * (scene.body_mass * q[1] + scene.foot_mass * q[4])


STIFFNESS = 1e4
KEPT = [
    (DoublePendulum(), lambda scene, q, v: scene.energy(np, q, v), 0.0),
    (CartpoleSwing(), cartpole_energy, 0.0),
    (HopperRun(leg_damping=0.0, friction=0.0), hopper_energy, np.array([[0.0], [2.0], [0.0], [0.0], [0.0]])),
]
"""Scenes without damping and friction, their energy, and the middle of their positions."""


@pytest.mark.parametrize(("scene", "energy", "middle"), KEPT, ids=lambda value: getattr(value, "name", ""))
def test_accelerations_keep_the_energy(scene, energy, middle):
    """d(energy)/dt = 0 from every state, in contact too."""
    q, v = np.random.default_rng(0).normal(size=(2, scene.n_q, 50))
    q = middle + 0.5 * q
    dynamics = Dynamics(LoopOps(), scene, Penalty(stiffness=STIFFNESS))
    a, eps = dynamics.acceleration(q, v, np.zeros((scene.n_u, 50))), 1e-5
    rate = (energy(scene, q + eps * v, v + eps * a) - energy(scene, q - eps * v, v - eps * a)) / (2 * eps)
    # differences: rounding of the energy over 1e-5, and 1e-10 times third derivatives
    assert np.abs(rate).max() < 1e-9 * (energy(scene, q, v).max() + np.abs(a).max())
