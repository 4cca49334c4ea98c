"""Scenes with free and ball joints: Jacobians by changes of the state, and gradients of engines through quaternions."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from classes import Penalty, SemiImplicitEuler, Windowed
from helpers import central_differences

from bench.model import JointScene, State, adjoint_gradient, compose, param, registry, slopes
from bench.model.manifold import difference, n_changes, retract
from bench.trace.trace import trace

mujoco = pytest.importorskip("mujoco")


@dataclass(frozen=True)
class Tumbling(JointScene):
    """A box thrown onto the ground, with a free joint, and a ball joint with a pendulum and a motor on a slide beside it."""

    name = "tumbling"
    joints: ClassVar[tuple[str, ...]] = ("free", "ball", "slide")
    n_u: ClassVar[int] = 1
    n_contacts: ClassVar[int] = 1
    feeds_back: ClassVar[bool] = False

    sigma: float = param(0.01, "standard deviation of the noise", positive=True)
    horizon: int = param(40, "number of time steps", positive=True)
    dt: float = param(0.005, "length of a time step", "s", positive=True)

    def theta0(self):
        return np.array([0.7, 0.4, 1.3, 0.2, -0.3])

    def initial_state(self, xp, theta):
        zero, one = 0.0 * theta[0], 1.0 + 0.0 * theta[0]
        angle = theta[0] / 2
        q = [zero, zero, zero + 0.12, xp.cos(angle), xp.sin(angle), zero, zero, one, zero, zero, zero, zero]
        v = [theta[1], zero, zero - 0.5, theta[2], one, zero, theta[3], one, theta[4], zero]
        return State(xp.stack(q), xp.stack(v))

    def feedback(self, xp, theta, q, v):
        return xp.stack([theta[3] * q[4] - theta[4] * v[3]]) if self.feeds_back else None

    def planned_controls(self, xp, theta):
        return None if self.feeds_back else theta[None, 3:4] + xp.zeros((self.horizon, 1, 1))

    def stage_cost(self, xp, q, v, u):
        return 0.1 * (q[4] * q[9] + v[3] * v[3] + u[0] * u[0])

    def terminal_cost(self, xp, q, v):
        return q[0] * q[0] + q[3] * q[5] + q[8] + v[4] * v[7] + q[11] * q[11]

    def mjcf(self):
        return """
            <option gravity="0 0 -9.81"/>
            <worldbody>
              <geom name="ground" type="plane" size="1 1 1"/>
              <body><freejoint/><geom name="box" type="sphere" size="0.1" pos="0.02 0 0.01" mass="0.4"/>
                <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.02 0.03"/></body>
              <body pos="2 0 3"><joint type="ball"/><inertial pos="0 0 -0.5" mass="1" diaginertia="0.01 0.02 0.03"/></body>
              <body pos="4 0 3"><joint name="slide" type="slide" axis="1 0 0"/>
                <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.02 0.03"/></body>
            </worldbody>
            <contact><pair geom1="ground" geom2="box" condim="3" friction="0.5 0.5 1 1 1"/></contact>
            <actuator><motor joint="slide"/></actuator>"""


@dataclass(frozen=True)
class Steered(Tumbling):
    """The same with feedback of the quaternion."""

    name = "steered"
    feeds_back: ClassVar[bool] = True


def problem(scene, backend="mujoco", **values):
    law = Penalty(stiffness=2000.0, damping=10.0, damping_mode="clipped")
    made = registry.make("backends", backend, values or None)
    assert made.refusal(compose(scene, law, SemiImplicitEuler())) is None
    return made.compile(compose(scene, law, SemiImplicitEuler()))


def test_lengths_follow_from_the_joints():
    assert (Tumbling.n_q, Tumbling.n_v, n_changes(Tumbling())) == (12, 10, 20)
    with pytest.raises(TypeError, match="joint 'screw'"):
        type("Wrong", (Tumbling,), {"joints": ("screw",)})


def test_retract_and_difference_are_inverse_and_agree_with_mujoco():
    rng, scene = np.random.default_rng(0), Tumbling()
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{scene.mjcf()}</mujoco>")
    x = rng.standard_normal((22, 6))
    for at in (slice(3, 7), slice(7, 11)):
        x[at] /= np.linalg.norm(x[at], axis=0)
    change = 1e-3 * rng.standard_normal((20, 6))
    there = retract(scene, np, x, change)
    np.testing.assert_allclose(difference(scene, np, there, x), change, atol=1e-12)
    for c in range(6):
        q, back = x[:12, c].copy(), np.empty(10)
        mujoco.mj_integratePos(model, q, np.ascontiguousarray(change[:10, c]), 1.0)
        np.testing.assert_allclose(there[:12, c], q, atol=1e-9)  # third order in the change
        mujoco.mj_differentiatePos(
            model, back, 1.0, np.ascontiguousarray(x[:12, c]), np.ascontiguousarray(there[:12, c])
        )
        np.testing.assert_allclose(back, change[:10, c], atol=1e-9)


@pytest.mark.parametrize("scene", [Tumbling(), Steered()], ids=lambda s: s.name)
def test_gradients_through_quaternions_equal_differences(scene):
    p = problem(scene)
    w = np.random.default_rng(1).standard_normal((p.program.n_noise, 4))
    expected = central_differences(p, p.program.theta0, w)
    gradient = p.grad(p.program.theta0, w)
    np.testing.assert_allclose(gradient, expected, atol=2e-5 * np.abs(expected).max())
    path = slopes(p, p.program.theta0, w)
    assert path.a.shape == (40, 20, 20, 4)
    np.testing.assert_allclose(adjoint_gradient(p, path), gradient, atol=1e-6 * np.abs(expected).max())


@pytest.mark.slow
def test_windows_and_traces_work_on_a_manifold():
    p = problem(Tumbling())
    noise = np.random.default_rng(2).standard_normal((2, 3, p.program.n_noise))
    assert np.isfinite(Windowed(steps=8, terminal="learned").estimate(p, p.program.theta0, noise)).all()
    table, error = trace(p, np.zeros((p.program.n_noise, 1)))
    assert error < 1e-5
    assert {"q12", "v10"} <= set(table.columns)
