"""Integrators and the smooth scenes that tell them apart: stability, order, energy, impacts, chaos."""

import dataclasses

import numpy as np
import pytest
from classes import (
    BouncingBall,
    DoublePendulum,
    EventDriven,
    Implicit,
    Impulse,
    Numpy,
    Penalty,
    StormerVerlet,
    Torch,
)

from bench.model import compose


def compiled(scene, integrator, law=None, backend=None):
    """On the given backend, or on a fast one that can run it."""
    backend = backend or (Implicit() if integrator.needs_root else Numpy())
    return backend.compile(compose(scene, law, integrator))


def quiet(problem):
    return np.zeros((problem.program.n_noise, 1))


def normal(problem, count, seed=0):
    return np.random.default_rng(seed).standard_normal((problem.program.n_noise, count))


def gradient(problem):
    """At theta0, without noise, ``(d,)``."""
    return problem.grad(problem.program.theta0, quiet(problem))[:, 0]


# ---------------------------------------------------------------------------------------------- double_pendulum


def test_double_pendulum_acceleration_is_that_of_its_energy():
    """d(energy)/dt = 0 from every state; hanging still is an equilibrium."""
    scene = DoublePendulum()
    q, v = np.random.default_rng(0).normal(size=(2, 2, 50))
    a, eps = scene.acceleration(np, q, v, np.zeros((0, 50))), 1e-5
    rate = (scene.energy(np, q + eps * v, v + eps * a) - scene.energy(np, q - eps * v, v - eps * a)) / (2 * eps)
    assert (
        np.abs(rate).max() < 1e-7
    )  # differences of step 1e-5: rounding 1e-11, truncation 1e-10 times third derivatives
    still = scene.acceleration(np, np.array([[0.0], [0.0]]), np.zeros((2, 1)), np.zeros((0, 1)))
    assert np.abs(still).max() == 0.0


# ------------------------------------------------------------------------------------------------- event_driven


def test_event_driven_gradients_across_noise():
    """Each of 1,000 samples, among which impacts fall everywhere within a step."""
    scene = BouncingBall(horizon=100, dt=0.01)
    problem = compiled(scene, EventDriven(), Impulse(), Torch())
    w = normal(problem, 1000)
    starts = scene.theta0()[:, None] + scene.sigma * w
    exact = [dataclasses.replace(scene, height=h, velocity=v).physical_gradient() for h, v in starts.T]
    assert problem.grad(scene.theta0(), w) == pytest.approx(np.transpose(exact), rel=1e-8, abs=1e-10)


def test_event_driven_without_impacts_is_stormer_verlet():
    for scene, law in (
        (DoublePendulum(horizon=20), None),
        (BouncingBall(horizon=100, dt=0.01), Penalty(stiffness=1e4)),
    ):
        event, plain = (compiled(scene, integrator, law) for integrator in (EventDriven(), StormerVerlet()))
        w = normal(event, 4)
        assert np.array_equal(event.value(scene.theta0(), w), plain.value(scene.theta0(), w))
