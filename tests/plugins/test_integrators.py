"""Integrators and the smooth scenes that tell them apart: stability, order, energy, impacts, chaos."""

import dataclasses
import math

import numpy as np
import pytest
from classes import (
    BounceOnce,
    BouncingBall,
    DoublePendulum,
    EventDriven,
    ExplicitEuler,
    Implicit,
    Impulse,
    Jax,
    MassSpring,
    Midpoint,
    Numpy,
    Penalty,
    Rk4,
    SemiImplicitEuler,
    StormerVerlet,
    Torch,
)

from bench.model import compose

EXPLICIT = [ExplicitEuler(), SemiImplicitEuler(), Midpoint(), Rk4(), StormerVerlet(), EventDriven()]


def named(plugin):
    return plugin.name


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


# -------------------------------------------------------------------------------------------------- mass_spring


@pytest.mark.parametrize("damping", [0.0, 1.0, 10.0, 15.0], ids=["undamped", "damped", "critical", "overdamped"])
@pytest.mark.parametrize("integrator", EXPLICIT, ids=named)
def test_mass_spring_gradient(integrator, damping):
    scene = MassSpring(damping=damping)
    problem = compiled(scene, integrator, backend=Torch())
    assert gradient(problem) == pytest.approx(scene.closed_form_gradient(None, integrator), rel=1e-9)


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

BOUNCES = [
    pytest.param(BouncingBall(), marks=pytest.mark.slow),
    BouncingBall(horizon=7, dt=1 / 7),
    pytest.param(BouncingBall(horizon=300, dt=0.01, velocity=1.0), marks=pytest.mark.slow),
    BouncingBall(horizon=120, dt=0.01, restitution=0.7, mass=3.0, velocity=-2.0),
]


@pytest.mark.parametrize("scene", BOUNCES, ids=lambda s: f"{s.horizon}x{s.dt:.3g}-e{s.restitution:g}-v{s.velocity:g}")
@pytest.mark.parametrize("law", [Impulse(), Impulse(time_of_impact=False)], ids=["time_of_impact", "without"])
def test_event_driven_gradient_is_the_physical_one(scene, law):
    """Constant acceleration leaves no discretisation error, at any dt; the same for JAX and torch."""
    for backend in (Jax(), Torch()):
        problem = compiled(scene, EventDriven(), law, backend)
        assert gradient(problem) == pytest.approx(scene.physical_gradient(), rel=1e-9)


def test_event_driven_gradients_across_noise():
    """Each of 1,000 samples, among which impacts fall everywhere within a step."""
    scene = BouncingBall(horizon=100, dt=0.01)
    problem = compiled(scene, EventDriven(), Impulse(), Torch())
    w = normal(problem, 1000)
    starts = scene.theta0()[:, None] + scene.sigma * w
    exact = [dataclasses.replace(scene, height=h, velocity=v).physical_gradient() for h, v in starts.T]
    assert problem.grad(scene.theta0(), w) == pytest.approx(np.transpose(exact), rel=1e-8, abs=1e-10)


@pytest.mark.parametrize("height", [1.0, pytest.param(1.0 + 1 / 480, marks=pytest.mark.slow)])
def test_event_driven_bounce_without_gravity(height):
    """Where the impact meets a step boundary too, which is a kink for force laws. The force of the first step acts at its middle."""
    scene = BounceOnce(height=height)
    found = gradient(compiled(scene, EventDriven(), Impulse(), Torch()))
    end = scene.horizon * scene.dt
    assert found == pytest.approx([-1.0, -end, -(end - scene.dt / 2) * scene.dt], rel=1e-9)
    assert scene.physical_gradient() == pytest.approx(found, rel=scene.dt)


def test_event_driven_without_impacts_is_stormer_verlet():
    for scene, law in (
        (DoublePendulum(horizon=20), None),
        (BouncingBall(horizon=100, dt=0.01), Penalty(stiffness=1e4)),
    ):
        event, plain = (compiled(scene, integrator, law) for integrator in (EventDriven(), StormerVerlet()))
        w = normal(event, 4)
        assert np.array_equal(event.value(scene.theta0(), w), plain.value(scene.theta0(), w))


@pytest.mark.slow
def test_event_driven_comes_to_rest():
    """After infinitely many bounces, by 1.36 s, it lies on the ground but for a sinking of less than dt^2 g / 2 a step."""
    scene = BouncingBall(horizon=640, restitution=0.5)
    assert scene.physical_gradient() is None
    problem = compiled(scene, EventDriven(), Impulse(), Torch())
    end = scene.target - math.sqrt(problem.value(scene.theta0(), quiet(problem))[0])
    assert -scene.horizon * scene.gravity * scene.dt**2 / 2 < end <= 0
    assert np.abs(gradient(problem)).max() < 0.01
