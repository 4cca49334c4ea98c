"""Scenes from MJCF files: motion, cost and gradients against MuJoCo's own."""

import numpy as np
import pytest

import bench
from bench.errors import UserError
from bench.experiment.by_name import compile_problem, make
from bench.experiment.keys import fingerprint
from bench.measure import noise
from bench.plugins import mjcf

mujoco = pytest.importorskip("mujoco")

DIFFERENCED = 1e-6
"""Relative error of differences of the cost, with a step of 1e-6 along a direction of length 1."""

PENDULUM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <geom type="plane" pos="0 0 -5" size="1 1 1"/>
    <body><joint name="hinge" type="hinge" axis="0 1 0" damping="{damping}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/></body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
  <keyframe><key qpos="0.5" ctrl="0.2"/></keyframe>
</mujoco>
"""
TASK = """
def observation(xp, q, v):
    return xp.concat([q, v])


def stage_cost(xp, q, v, u):
    return q[0] ** 2 + 0.01 * xp.sum(u * u, axis=0)
"""


@pytest.fixture
def pendulum(tmp_path):
    (tmp_path / "pendulum.xml").write_text(PENDULUM.format(damping=0.1))
    (tmp_path / "pendulum.py").write_text(TASK)
    return tmp_path / "pendulum.xml"


def problem(file="quadruped.xml", backend="mujoco", **values):
    given = ",".join(f"{name}={value}" for name, value in {"file": file, "horizon": 6, **values}.items())
    return compile_problem(f"mjcf[{given}]", None, "semi_implicit_euler", backend)


def drawn(problem, count=3):
    return noise.draw(0, "mjcf", 1, count, problem.program.n_noise, "test")[0].T


def test_costs_are_those_of_a_loop_over_mujoco(pendulum):
    given = problem(pendulum, substeps=2, dt=0.02)
    w = drawn(given, 1)
    model = mujoco.MjModel.from_xml_path(str(pendulum))
    data, theta = mujoco.MjData(model), given.program.theta0
    mujoco.mj_resetDataKeyframe(model, data, 0)
    total = 0.0
    for t in range(6):
        u = 0.2 + 0.3 * (theta[:2] @ [data.qpos[0], data.qvel[0]] + theta[2]) + 0.05 * w[t, 0]
        total += data.qpos[0] ** 2 + 0.01 * u**2
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
        mujoco.mj_step(model, data)
    assert given.value(theta, w)[0] == pytest.approx(total, rel=1e-12)


@pytest.mark.parametrize(
    "values",
    [{}, {"policy": "mlp[hidden=4]"}, {"noise": "parameter"}, {"noise": "parameter", "theta": "velocity"}],
)
def test_gradients_are_differences_of_the_cost(values):
    given = problem(**values)
    theta, w = given.program.theta0, drawn(given)
    along = np.random.default_rng(0).standard_normal(len(theta))
    along /= np.linalg.norm(along)
    step = 1e-6 * along
    differences = (given.value(theta + step, w) - given.value(theta - step, w)) / 2e-6
    assert along @ given.grad(theta, w) == pytest.approx(differences, rel=100 * DIFFERENCED)


def test_a_fallen_robot_stays_where_it_fell(tmp_path):
    (tmp_path / "pendulum.xml").write_text(PENDULUM.format(damping=0.0))
    (tmp_path / "pendulum.py").write_text(TASK + "\n\ndef has_ended(xp, q, v):\n    return q[0] < 0.3\n")
    given = problem(tmp_path / "pendulum.xml", horizon=60)
    w = drawn(given)
    path = given.trajectory(given.program.theta0, w)
    ended = path.states[:, 0] < 0.3
    assert ended[-1].all()
    first = int(np.argmax(ended[:, 0]))
    assert (path.states[first:, :, 0] == path.states[first, :, 0]).all()
    a = given.jacobians(given.program.theta0, w).a
    assert (a[-1] == np.eye(2)[..., None]).all()


def test_a_changed_file_changes_the_key(pendulum):
    before = fingerprint(make("scenes", f"mjcf[file={pendulum}]"))
    pendulum.write_text(PENDULUM.format(damping=0.2))
    assert fingerprint(make("scenes", f"mjcf[file={pendulum}]")) != before
    changed = fingerprint(make("scenes", f"mjcf[file={pendulum}]"))
    # a module is imported once per process, so its next version has another name here
    other = pendulum.with_name("other.py")
    other.write_text(TASK.replace("0.01", "0.02"))
    assert make("scenes", f"mjcf[file={pendulum},functions={other}]").files() == (other, pendulum)
    assert fingerprint(make("scenes", f"mjcf[file={pendulum},functions={other}]")) != changed


ELLIPTIC = {"<option": '<option cone="elliptic"'}
PASSIVE = {'<motor joint="hinge"/>': "", 'ctrl="0.2"': 'qvel="0.3"'}
NO_COST = {"def stage_cost": "def no_cost"}
BAD = [
    ({}, {"file": "quadrupd.xml"}, "quadrupd.xml.*quadruped.xml"),
    ({}, {"file": "/nowhere/robot.xml"}, "this file does not exist"),
    ({}, {"file": "nosuchpackage:robot.xml"}, "pip install nosuchpackage"),
    ({}, {"functions": "/nowhere/task.py"}, "/nowhere/task.py does not exist"),
    (NO_COST, {}, "defines no function stage_cost"),
    ({"<body>": "<bdy>"}, {}, r"cannot be read: (.|\n)*bdy"),
    (PASSIVE, {}, "no actuators for a policy: use theta=velocity"),
    (PASSIVE, {"theta": "velocity"}, "no actuators for noise=action: use noise=parameter"),
    ({}, {"backend": "mjx"}, r"use mjx\[iterations=20\]"),
    ({}, {"backend": "mjx[derivative=unrolled]"}, r"use mjx\[iterations=20\]"),
    ({}, {"backend": "mjx[iterations=5,derivative=unrolled,mode=reverse]"}, "no reverse mode with iterations=5"),
    (ELLIPTIC, {"backend": "mjx[iterations=5]"}, r"elliptic cones: use mjx\[cone=elliptic\]"),
    (ELLIPTIC, {"backend": "mujoco[cone=pyramidal]"}, r"elliptic cones: use mujoco\[cone=elliptic\]"),
    ({}, {"backend": "mujoco[impedance=0.5]"}, "impedance=0.5 would have no effect"),
    ({"<geom": '<geom condim="1"'}, {"backend": "mjx[iterations=5,cone=elliptic]"}, "use pyramidal cones"),
    ({}, {"backend": "mjx[iterations=5,cone=elliptic,derivative=unrolled]"}, "NaN with elliptic friction cones"),
]
"""Texts changed in the model and the task, settings, and the message."""


def changed(file, changes):
    for path in (file, file.with_suffix(".py")):
        for old, new in changes.items():
            path.write_text(path.read_text().replace(old, new))
    return file


@pytest.mark.parametrize(("changes", "values", "message"), BAD)
def test_what_cannot_be_run_is_named(pendulum, changes, values, message):
    with pytest.raises(bench.Unsupported if "backend" in values else UserError, match=message):
        problem(**{"file": changed(pendulum, changes), **values})


@pytest.mark.parametrize("changes", [{}, ELLIPTIC])
def test_an_elliptic_cone_replaces_that_of_the_file(pendulum, changes):
    given = problem(changed(pendulum, changes), "mujoco[cone=elliptic]")
    assert mjcf.build(given._backend, given.program).opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC


def test_a_file_without_actuators_has_velocities_as_theta(pendulum):
    given = problem(changed(pendulum, PASSIVE), theta="velocity", noise="parameter")
    assert np.isfinite(given.grad(given.program.theta0, drawn(given))).all()
    assert given.program.theta0 == 0.3


@pytest.mark.slow
def test_the_derivative_of_a_robot_is_that_of_the_c_engine():
    """Of minus the sum of gymnasium's cheetah's forward velocities, by the first one at the start, with elliptic cones."""
    pytest.importorskip("gymnasium")
    file = "gymnasium:envs/mujoco/assets/half_cheetah.xml,functions=half_cheetah.py"
    scene = f"mjcf[file={file},horizon=40,substeps=1,theta=velocity,noise=parameter]"
    given = compile_problem(scene, None, "semi_implicit_euler", "mjx[iterations=10,cone=elliptic,mode=reverse]")
    model, w = given.program.source, np.zeros((given.dim, 1))
    model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0.0, 100, 50

    def by_c(start):
        data, total = mujoco.MjData(model), 0.0
        data.qvel[:] = start
        for _ in range(40):
            total -= data.qvel[0]
            mujoco.mj_step(model, data)
        return total

    first = np.eye(given.dim)[0]
    for cost in (by_c, lambda start: given.value(start, w)):
        assert (cost(1e-5 * first) - cost(-1e-5 * first)) / 2e-5 == pytest.approx(-22.726411503, rel=1e-8)
    assert given.grad(0 * first, w)[0] == pytest.approx(-22.726411503, rel=1e-8)
