"""Training on the steps of a physics engine: the transitions of MJX against MuJoCo's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bench.experiment.by_name import make
from bench.model import compose
from bench.training.environment import Environment

mujoco = pytest.importorskip("mujoco")
pytest.importorskip("mujoco.mjx")

BALL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <geom type="plane" size="5 5 0.1"/>
    <body pos="0 0 0.08"><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <geom type="sphere" size="0.1" mass="1"/></body>
  </worldbody>
  <actuator>
    <motor joint="x" gear="10" ctrllimited="true" ctrlrange="-1 1"/>
    <motor joint="z" gear="20" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
  <keyframe><key qpos="0 0.02" ctrl="0.1 0"/></keyframe>
</mujoco>
"""
TASK = """
n_start = 2


def observation(xp, q, v):
    return xp.concat([q, v])


def stage_cost(xp, q, v, u):
    return (q[0] - 0.5) ** 2 + 0.01 * xp.sum(u * u, axis=0)


def random_start(xp, q, v, e):
    return q, v + 0.1 * e
"""


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    (folder / "ball.xml").write_text(BALL)
    (folder / "ball.py").write_text(TASK)
    scene = make("scenes", f"mjcf[file={folder / 'ball.xml'},horizon=6,substeps=2,dt=0.02,action_scale=0.8]")
    backend = make("backends", "mjx[iterations=20]")
    program = backend.compile(compose(scene, None, make("integrators", "semi_implicit_euler"))).program
    return folder / "ball.xml", Environment(program, backend.ops(), "float64")


@pytest.mark.slow
def test_a_transition_is_that_of_mujoco_with_bounded_controls(ball):
    path, env = ball
    numbers, action = np.array([[1.0], [-2.0]]), np.array([[3.0], [-0.4]])
    moved = jax.jit(lambda p, start, action: env.bind(p).step(start, action, jnp.zeros((2, 1))))(
        env.parameters(), env.start(jnp.asarray(numbers)), jnp.asarray(action)
    )
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qvel[:] = 0.1 * numbers[:, 0]
    data.ctrl[:] = np.array([0.1, 0.0]) + 0.8 * np.tanh(action[:, 0])
    reward = -((data.qpos[0] - 0.5) ** 2 + 0.01 * (data.ctrl**2).sum())
    for _ in range(2):
        mujoco.mj_step(model, data)
    assert float(moved.reward[0]) == pytest.approx(reward, rel=1e-12)
    contacts, depth, force = jax.jit(lambda p, state: env.bind(p).contacts(state))(env.parameters(), moved.reached)
    mujoco.mj_forward(model, data)
    assert float(contacts[0]) == data.ncon == 1
    assert float(depth[0]) == pytest.approx(-data.contact.dist.min(), abs=1e-7)
    assert np.isnan(force).all()
    np.testing.assert_allclose(np.concatenate(moved.reached)[:, 0], [*data.qpos, *data.qvel], rtol=1e-6, atol=1e-9)
