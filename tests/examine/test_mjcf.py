"""A MuJoCo model of one's own: free joints, quaternions and motors, against differences of its rollouts."""

import numpy as np
import pytest

import bench
from bench.errors import UserError

pytest.importorskip("mujoco")

CUBE = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 0.2"><freejoint/><geom type="box" size="0.1 0.1 0.1" mass="1"/></body>
  </worldbody>
</mujoco>
"""
ARM = """
<mujoco>
  <worldbody><body><joint name="hinge" type="hinge" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03"/></body></worldbody>
  <actuator><motor joint="hinge" gear="2"/></actuator>
</mujoco>
"""


def away(model, data):
    return (data.qpos[0] - 0.3) ** 2 + data.qpos[1] ** 2


def test_cube_with_a_quaternion_has_the_gradient_of_its_rollout():
    """nq = 7, nv = 6: it spins and hits the floor within the 40 steps."""
    toss = bench.Mjcf(CUBE, lambda model, data, theta: {"qvel": theta}, away, steps=40)
    theta = np.array([1.0, 0.2, -1.0, 1.0, 2.0, -1.0])
    differences = [(toss(theta + h) - toss(theta - h)) / 2e-5 for h in 1e-5 * np.eye(6)]
    # chained differences of steps err by 1e-6 of the largest slope, those of rollouts by as much at a contact
    np.testing.assert_allclose(toss.gradient(theta), differences, atol=1e-5 * np.abs(differences).max())


def test_start_may_turn_the_body():
    """Theta is a quaternion that the engine normalises: the tangent space sees what remains."""
    toss = bench.Mjcf(
        CUBE, lambda model, data, theta: {"qpos": np.r_[0, 0, 0.2, theta], "qvel": [1, 0, 0, 0, 1, 0]},
        lambda model, data: data.xmat[1][0] + data.qpos[2], steps=10,
    )  # fmt: skip
    theta = np.array([1.0, 0.1, -0.2, 0.05]) / np.linalg.norm([1.0, 0.1, -0.2, 0.05])
    differences = np.array([(toss(theta + h) - toss(theta - h)) / 2e-5 for h in 1e-5 * np.eye(4)])
    np.testing.assert_allclose(toss.gradient(theta), differences, atol=1e-4)


def test_motor_with_feedback_has_the_gradient_of_its_rollout():
    def control(model, data, theta, t):
        return [theta[0] * data.qpos[0] + theta[1] * data.qvel[0] + theta[2]]

    swing = bench.Mjcf(ARM, lambda m, d, theta: {"qpos": [0.5]}, lambda m, d: d.qpos[0] ** 2, steps=50, control=control)
    report = bench.examine(swing, [-3.0, -0.2, 0.4], grad=swing.gradient, progress=False)
    assert report.status == 0, str(report)


def test_bad_models_and_engines_say_so():
    with pytest.raises(UserError, match="did you mean 'mujoco'"):
        bench.Mjcf(CUBE, lambda *a: {}, away, 1, engine="mujco")
    with pytest.raises(UserError, match="the model cannot be read"):
        bench.Mjcf("<mujoco><nothing/></mujoco>", lambda *a: {}, away, 1)


@pytest.mark.slow
def test_mjx_gives_the_gradient_of_its_own_cube():
    import jax

    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    try:
        toss = bench.Mjcf(CUBE, lambda model, data, theta: {"qvel": theta}, away, steps=20, engine="mjx")
        theta = np.array([1.0, 0.2, -3.0, 1.0, 2.0, -1.0])
        differences = [(toss(theta + h) - toss(theta - h)) / 2e-5 for h in 1e-5 * np.eye(6)]
        np.testing.assert_allclose(toss.gradient(theta), differences, atol=1e-4 * np.abs(differences).max())
    finally:
        jax.config.update("jax_enable_x64", before)


def test_start_that_sets_fields_itself_is_told_to_return_them():
    def start(model, data, theta):
        data.qvel[:] = theta

    with pytest.raises(UserError, match="start returned None: it must return fields of the data by name"):
        bench.Mjcf(CUBE, start, away, steps=1)(np.zeros(6))
    with pytest.raises(UserError, match="did you mean 'qvel'"):
        bench.Mjcf(CUBE, lambda model, data, theta: {"qvell": theta}, away, steps=1)(np.zeros(6))
