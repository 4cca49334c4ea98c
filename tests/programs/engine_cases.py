"""Runs `bench.examine` on failures of engines and on simulators of other fields, and writes a table.

    python tests/programs/engine_cases.py [OUT.md] [NAME ...]

With names, or parts of names, only those cases run, and only their rows change.

Each case runs in a process of its own with the default budget of `bench.examine`. It needs an environment with the engines
(`examples/requirements-engines.txt`) and `diffrax torchdiffeq jax-md phiflow`; a case whose library is missing is a row that
says so. The table states the cause that was found, the seconds with first calls, the calls and the peak memory of the process.
"""

import ctypes
import functools
import itertools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 1200
"""Seconds for one case."""
HEAD = ("case", "library", "expected", "found", "named", "seconds", "of these first calls", "costs + gradients", "GB")
MARK = "\x1eROW "
BEGIN, END = "<!-- cases -->\n", "<!-- end of cases -->"
RIGHT = ("smooth", "nonlinear", "rounding", "saturated", "mode_crossing")
"""Causes of a right gradient."""


@dataclass(frozen=True)
class Case:
    """A cost with a gradient: ``make()`` returns (cost, theta, settings) of `bench.examine`."""

    name: str
    library: str
    """The package, as pip names it."""
    expected: tuple[str, ...]
    """Causes that name the planted or known fault, or :data:`RIGHT`."""
    make: Callable[[], tuple[Any, Any, dict[str, Any]]]


CASES: dict[str, Case] = {}


def case(name: str, library: str, *expected: str, **variants: Any) -> Callable[..., Any]:
    """Register a function as a case."""

    def register(make: Callable[..., Any]) -> Callable[..., Any]:
        CASES[name] = Case(name, library, expected or RIGHT, functools.partial(make, **variants))
        return make

    return register


# ------------------------------------------------------------------------------------------------ engines: MJX, MuJoCo

SLIDER = """<mujoco><option timestep="0.005" cone="{cone}" iterations="{iterations}"><flag frictionloss="{loss}"/></option>
<worldbody><geom type="plane" size="5 5 1" friction=".5" condim="{condim}"/><body pos="0 0 0.095">
<joint type="slide" axis="1 0 0" frictionloss=".2"/><joint type="slide" axis="0 0 1"/>
<geom type="sphere" size="0.1" mass="1" friction=".5" condim="{condim}"/></body></worldbody></mujoco>"""


def slider(height=0.001, by_distance=False, by_friction=False, speed=1.0, **options):
    """Return a ball that slides on a plane, or flies above it, for one step; theta is its position and velocity.

    All of the state depends on theta, since XLA evaluates what is constant while it compiles, for minutes.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp
    import mujoco
    from mujoco import mjx

    settings = {"cone": "pyramidal", "iterations": 1, "condim": 3, "loss": "enable"} | options
    model = mjx.put_model(mujoco.MjModel.from_xml_string(SLIDER.format(**settings)))

    def moved(m, x):
        return mjx.step(m, mjx.make_data(m).replace(qpos=x[:2], qvel=x[2:])).qpos

    def cost(x):
        q = moved(model, x)
        return jnp.linalg.norm(q[:1]) if by_distance else (q[0] - 0.2) ** 2 + q[1] ** 2

    def with_friction(p):
        m = model.replace(dof_frictionloss=model.dof_frictionloss.at[0].set(p["friction loss"]))
        return moved(m, jnp.array([0.01, 0.001, 1.0, -0.2]) * p["speed"])[0] ** 2

    if by_friction:
        return with_friction, {"friction loss": 0.2, "speed": 1.0}, {"grad": "jax", "allow_zero": False}
    return cost, np.array([0.0 if by_distance else 0.1, height, speed, -0.2]), {"grad": "jax"}


case("MJX, elliptic cone, above the ground", "mujoco-mjx", "nan_gradient", cone="elliptic", height=0.1)(slider)
case("MJX, reverse mode with 20 iterations", "mujoco-mjx", "raised", iterations=20)(slider)
case("MJX, distance to the target, at the target", "mujoco-mjx", "nan_gradient", by_distance=True, speed=0.0)(slider)
case("MJX, friction loss disabled", "mujoco-mjx", "no_effect", by_friction=True, loss="disable")(slider)
case("MJX, pyramidal cone, one iteration", "mujoco-mjx")(slider)


def mujoco_warm(iterations):
    import mujoco

    options = {"cone": "pyramidal", "iterations": iterations, "condim": 3, "loss": "enable"}
    model = mujoco.MjModel.from_xml_string(SLIDER.format(**options))
    data = mujoco.MjData(model)

    def cost(v):
        data.qpos[:], data.qvel[:] = 0.0, v
        for _ in range(20):
            mujoco.mj_step(model, data)
        return float((data.qpos[0] - 0.2) ** 2)

    def grad(v):
        return [(cost(v + 1e-6 * e) - cost(v - 1e-6 * e)) / 2e-6 for e in np.eye(2)]

    return cost, [1.0, -0.2], {"grad": grad}


KEPT = "MuJoCo, data and warm start kept between calls"
case(f"{KEPT}, one iteration", "mujoco", "nondeterministic", iterations=1)(mujoco_warm)
case(f"{KEPT}, two iterations", "mujoco", iterations=2)(mujoco_warm)  # calls differ in the last digits only


# ------------------------------------------------------------------------------------------------ engines: Warp, Newton


def _quiet_warp():
    import warp as wp

    wp.config.quiet = True
    wp.set_device("cpu")
    return wp


@case("Newton Featherstone, one tape over 30 steps", "newton", "overwritten")
def featherstone():
    _quiet_warp()
    sys.path.insert(0, str(ROOT / "examples"))
    import newton_cartpole as n

    settings = {"grad": lambda x, steps=30: n.rollout(x, steps, False)[1], "horizons": [1, 10, 30], "tolerance": 0.01}
    settings["twin_grad"] = lambda x: n.rollout(x, 30, True)[1]
    return lambda x, steps=30: n.rollout(x, steps, False)[0], n.theta, settings


@case("Newton Featherstone, a solver per step", "newton")
def featherstone_right():
    _quiet_warp()
    sys.path.insert(0, str(ROOT / "examples"))
    import newton_cartpole as n

    return lambda x: n.rollout(x, 10, True)[0], n.theta, {"grad": lambda x: n.rollout(x, 10, True)[1]}


def newton_body(solver_name, start=(0.12, -1.0), steps=30, axis=2):
    """Return a rigid ball at the ground after some steps of one of Newton's solvers; theta is its height and a speed.

    The speed and the position in the cost are along an axis: 0 slides, 2 falls.
    """
    wp = _quiet_warp()
    import newton

    builder = newton.ModelBuilder()
    builder.default_shape_cfg.ke, builder.default_shape_cfg.kd = 1e3, 0.0
    body = builder.add_body(xform=wp.transform((0, 0, 0.5), wp.quat_identity()))
    builder.add_shape_sphere(body, radius=0.1)
    builder.add_ground_plane()
    model = builder.finalize(requires_grad=True)
    pipeline = newton.CollisionPipeline(model, requires_grad=True)

    def rollout(x):
        solver = getattr(newton.solvers, f"Solver{solver_name}")(model)
        states = [model.state() for _ in range(steps + 1)]
        q, qd = states[0].body_q.numpy(), states[0].body_qd.numpy()
        q[body][2], qd[body][axis] = x
        states[0].body_q.assign(q)
        states[0].body_qd.assign(qd)
        newton.eval_ik(model, states[0], states[0].joint_q, states[0].joint_qd)
        with wp.Tape() as tape:
            for before, after in itertools.pairwise(states):
                contacts = pipeline.contacts()
                pipeline.collide(before, contacts)
                before.clear_forces()
                solver.step(before, after, model.control(), contacts, 2e-3)
        place = states[-1].body_q.numpy()[body][axis]
        seed = np.zeros((model.body_count, 7), np.float32)
        seed[body][axis] = 2 * (place - np.float32(0.3))
        tape.backward(grads={states[-1].body_q: wp.array(seed, dtype=wp.transform)})
        by_place, by_speed = states[0].body_q.grad.numpy()[body], states[0].body_qd.grad.numpy()[body]
        if solver_name == "Featherstone":  # which steps joint coordinates
            by_place, by_speed = states[0].joint_q.grad.numpy(), states[0].joint_qd.grad.numpy()
        return float((place - np.float32(0.3)) ** 2), [float(by_place[2]), float(by_speed[axis])]

    return lambda x: rollout(x)[0], list(start), {"grad": lambda x: rollout(x)[1]}


WRONG = ("wrong_adjoint", "missing_term", "wrong_factor", "disconnected")
# two iterations leave (1 - 0.8)^2 = 0.04 of the depth, so the height changes by 0.04 of a change of the start
case(
    "Newton XPBD, a rigid body pressed into the ground",
    "newton",
    *WRONG,
    solver_name="XPBD",
    start=(0.0995, -1.0),
    steps=1,
)(newton_body)
case("Newton Featherstone, a free joint", "newton", solver_name="Featherstone")(newton_body)


def warp_rollout(fault):
    """Return a rollout of a spring, 20 steps in a Warp kernel: (cost, gradient, tape).

    ``fault`` overwrites the ``state`` or the ``parameter`` that the adjoint reads, or doubles the ``adjoint`` of the sine.
    """
    wp = _quiet_warp()
    dt, factor = wp.constant(wp.float64(0.05)), wp.constant(wp.float64(2.0 if fault == "adjoint" else 1.0))

    @wp.func
    def sine(x: wp.float64):
        return wp.sin(x)

    @wp.func_grad(sine)
    def adjoint_of_sine(x: wp.float64, slope: wp.float64):
        wp.adjoint[x] += factor * wp.cos(x) * slope

    array = wp.array(dtype=wp.float64)

    @wp.kernel
    def step(k: array, x: array, v: array, after_x: array, after_v: array):
        speed = v[0] - dt * k[0] * sine(x[0])
        after_x[0] = x[0] + dt * speed
        after_v[0] = speed

    @wp.kernel
    def soften(k: array):
        k[0] = k[0] * wp.float64(0.9)

    def numbers(value):
        return wp.array([value], dtype=wp.float64, requires_grad=True)

    def rollout(theta, steps=20):
        x, v, k = [numbers(theta[0])], [numbers(theta[1])], numbers(theta[2])
        with wp.Tape() as tape:
            for _ in range(steps):
                if fault == "parameter":
                    wp.launch(soften, dim=1, inputs=[], outputs=[k])
                after = (x[0], v[0]) if fault == "state" else (numbers(0.0), numbers(0.0))
                wp.launch(step, dim=1, inputs=[k, x[-1], v[-1]], outputs=[*after])
                x.append(after[0])
                v.append(after[1])
        end = x[-1].numpy()[0]
        tape.backward(grads={x[-1]: wp.array([2 * end], dtype=wp.float64)})
        return float(end**2), [one.grad.numpy()[0] for one in (x[0], v[0], k)], tape

    return rollout


SPRING = [0.7, 0.3, 9.0]


def warp_spring(fault):
    rollout = warp_rollout(fault)
    settings = {"grad": lambda x, steps=20: rollout(x, steps)[1]}
    if fault in ("state", "parameter"):
        settings["horizons"] = [1, 2, 5, 20]
    return lambda x, steps=20: rollout(x, steps)[0], SPRING, settings


case("Warp, parameter overwritten between launches", "warp-lang", "overwritten", fault="parameter")(warp_spring)
case("Warp, state overwritten in place", "warp-lang", "overwritten", fault="state")(warp_spring)
case("Warp, adjoint of a function doubled", "warp-lang", *WRONG, fault="adjoint")(warp_spring)
case("Warp, an array entry per step", "warp-lang", fault="")(warp_spring)


@case("MuJoCo Warp, a tape around its steps", "mujoco-warp", *WRONG, "nan_gradient")
def mujoco_warp():
    wp = _quiet_warp()
    import mujoco
    import mujoco_warp as mjw

    options = {"cone": "pyramidal", "iterations": 4, "condim": 3, "loss": "enable"}
    host = mujoco.MjModel.from_xml_string(SLIDER.format(**options))
    model = mjw.put_model(host)

    def rollout(v):
        data = mjw.make_data(host)
        data.qvel.assign(np.float32([v]))
        data.qvel.requires_grad = data.qpos.requires_grad = True
        with wp.Tape() as tape:
            for _ in range(4):
                mjw.step(model, data)
        q = data.qpos.numpy()[0]
        tape.backward(grads={data.qpos: wp.array(np.float32([[2 * (q[0] - 0.2), 2 * q[1]]]), dtype=wp.float32)})
        return float((q[0] - np.float32(0.2)) ** 2 + q[1] ** 2), data.qvel.grad.numpy()[0]

    return lambda v: rollout(v)[0], [1.0, -0.2], {"grad": lambda v: rollout(v)[1]}


# ------------------------------------------------------------------------------------------------ engines: Drake, Genesis


@case("Drake, speed of a body at rest", "drake", "nan_gradient")
def drake_rest():
    import pydrake.all as drake

    builder = drake.DiagramBuilder()
    plant, _ = drake.AddMultibodyPlantSceneGraph(builder, time_step=2e-3)
    body = plant.AddRigidBody("body", drake.SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.AddJoint(drake.PrismaticJoint("slide", plant.world_frame(), body.body_frame(), [1, 0, 0]))
    plant.Finalize()
    diagram = builder.Build()
    models = {float: diagram, drake.AutoDiffXd: diagram.ToAutoDiffXd()}

    def cost(x, kind=float):
        model = models[kind]
        simulator = drake.Simulator_[kind](model)
        own, context = model.GetSubsystemByName("plant"), simulator.get_mutable_context()
        zero = 0.0 * x[0]
        own.SetPositionsAndVelocities(own.GetMyMutableContextFromRoot(context), [x[0], zero])
        simulator.AdvanceTo(0.1)
        q, v = own.GetPositionsAndVelocities(own.GetMyContextFromRoot(context))
        return (q - 0.3) ** 2 + 0.1 * np.sqrt(v * v)

    return (
        lambda x: float(cost(x)),
        [0.5],
        {"grad": lambda x: cost(drake.InitializeAutoDiff(x)[:, 0], drake.AutoDiffXd).derivatives()},
    )


@case("Genesis, scenes with and without gradients", "genesis-world")
def genesis_twin():
    """Compares costs only, which agree: the backward pass compiles for more than 20 minutes on a loaded machine."""
    import genesis as gs
    import torch

    gs.init(backend=gs.cpu, precision="64", logging_level="error")

    def scene_of(requires_grad):
        scene = gs.Scene(sim_options=gs.options.SimOptions(dt=4e-3, requires_grad=requires_grad), show_viewer=False)
        scene.add_entity(gs.morphs.Plane())
        box = scene.add_entity(gs.morphs.Box(size=(0.2, 0.2, 0.2), pos=(0.0, 0.0, 0.5)))
        scene.build()
        return scene, box

    scenes = {requires_grad: scene_of(requires_grad) for requires_grad in (True, False)}

    def cost(x, with_gradient):
        scene, box = scenes[with_gradient]
        scene.reset()
        box.set_pos(torch.tensor([0.0, 0.0, x[0]]))
        box.set_dofs_velocity(torch.tensor([0.0, 0.0, x[1], 0.0, 0.0, 0.0]))
        for _ in range(3):
            scene.step()
        return float((box.get_state().pos.reshape(-1)[2] - 0.3) ** 2)

    return lambda x: cost(x, True), [0.099, -1.0], {"twin": lambda x: cost(x, False)}


# ------------------------------------------------------------------------------------------------ adaptive ODE solvers


def van_der_pol(p, y, stack):
    return stack([y[1], p * (1 - y[0] ** 2) * y[1] - y[0]])


def dopri5(rtol=1e-6, adjoint=False, forgotten=False, is_refined=False):
    import torch

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    import torchdiffeq

    def solved(rtol):
        def cost(p):
            solver = torchdiffeq.odeint_adjoint if adjoint else torchdiffeq.odeint
            damping = p[0].detach() if forgotten else p[0]
            more = {"adjoint_params": (p,)} if adjoint else {}
            at = torch.tensor([0.0, 1.0])
            y = solver(lambda t, y: van_der_pol(damping, y, torch.stack), torch.stack([p[1], p[2]]), at,
                       method="dopri5", rtol=rtol, atol=rtol * 1e-2, **more)  # fmt: skip
            return (y[-1] ** 2).sum()

        return cost

    return solved(rtol), [2.0, 1.0, 0.5], {"grad": "torch", **({"refined": solved(1e-9)} if is_refined else {})}


case("dopri5, rtol 1e-6", "torchdiffeq", "adaptive", *RIGHT)(dopri5)
case("dopri5, rtol 1e-3, with refined=", "torchdiffeq", "adaptive", rtol=1e-3, is_refined=True)(dopri5)
case("odeint_adjoint used rightly", "torchdiffeq", *RIGHT, "adaptive", adjoint=True)(dopri5)
case("dopri5, a detached parameter", "torchdiffeq", "disconnected", forgotten=True)(dopri5)


def diffrax_cost(rtol=1e-6, forgotten=False, is_refined=False):
    import jax

    jax.config.update("jax_enable_x64", True)
    import diffrax
    import jax.numpy as jnp

    def solved(rtol):
        def cost(p):
            damping = jax.lax.stop_gradient(p[0]) if forgotten else p[0]
            term = diffrax.ODETerm(lambda t, y, args: van_der_pol(damping, y, jnp.stack))
            control = diffrax.PIDController(rtol=rtol, atol=rtol * 1e-2)
            solution = diffrax.diffeqsolve(term, diffrax.Dopri5(), 0.0, 3.0, 0.01, p[1:], stepsize_controller=control)
            return jnp.sum(solution.ys[-1] ** 2)

        return cost

    return solved(rtol), np.array([1.0, 1.0, 0.5]), {"grad": "jax", **({"refined": solved(1e-9)} if is_refined else {})}


case("recursive checkpoints, rtol 1e-6", "diffrax")(diffrax_cost)
case("recursive checkpoints, rtol 1e-3, with refined=", "diffrax", "adaptive", rtol=1e-3, is_refined=True)(diffrax_cost)
case("recursive checkpoints, a stopped gradient", "diffrax", "disconnected", forgotten=True)(diffrax_cost)


def solve_ivp_cost(rtol=1e-6, step=1.5e-8):
    from scipy.integrate import solve_ivp

    def cost(x):
        slope = lambda t, y: [y[1], x[0] * (1 - y[0] ** 2) * y[1] - y[0]]  # noqa: E731
        end = solve_ivp(slope, (0, 3), [x[1], x[2]], rtol=rtol, atol=rtol * 1e-2).y[:, -1]
        return float((end**2).sum())

    def grad(x):
        first = cost(x)
        return [(cost(x + step * e) - first) / step for e in np.eye(3)]

    return cost, [1.0, 1.0, 0.5], {"grad": grad}


case("solve_ivp, forward differences", "scipy")(solve_ivp_cost)
case("solve_ivp, forward differences of 1e-14", "scipy", *WRONG, step=1e-14)(solve_ivp_cost)


# ------------------------------------------------------------------------------------------------ other fields


def molecules(forgotten=False):
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp
    from jax_md import energy, simulate, space

    box = 4.0
    shift_by, shift = space.periodic(box)
    start = jnp.asarray(np.random.default_rng(0).random((16, 2)) * box)

    def cost(p):
        sigma = jax.lax.stop_gradient(p["sigma"]) if forgotten else p["sigma"]
        potential = energy.soft_sphere_pair(shift_by, sigma=sigma, epsilon=p["epsilon"])
        init, apply = simulate.nve(potential, shift, 1e-2)
        state = init(jax.random.PRNGKey(0), start, kT=0.1)
        state, _ = jax.lax.scan(lambda s, _: (apply(s), None), state, None, length=40)
        return potential(state.position)

    return cost, {"sigma": np.float64(1.0), "epsilon": np.float64(1.0)}, {"grad": "jax"}


case("molecular dynamics", "jax-md")(molecules)
case("molecular dynamics, a stopped gradient", "jax-md", "disconnected", "missing_term", forgotten=True)(molecules)


def fluid(forgotten=False):
    import jax

    jax.config.update("jax_enable_x64", True)
    from phi.jax import flow

    flow.math.set_global_precision(64)
    start = np.sin(np.linspace(0, 2 * np.pi, 32, endpoint=False)) + 0.3

    def cost(p):
        values = flow.math.tensor(start * p["amplitude"], flow.spatial("x"))
        u = flow.CenteredGrid(values, flow.extrapolation.PERIODIC, bounds=flow.Box(x=1.0))
        viscosity = jax.lax.stop_gradient(p["viscosity"]) if forgotten else p["viscosity"]
        for _ in range(5):
            u = flow.diffuse.explicit(u, flow.math.tensor(viscosity), 1e-2, substeps=2)
            u = flow.advect.semi_lagrangian(u, u * flow.vec(x=1.0), 1e-2)
        return (u.values.native("x") ** 2).sum()

    return cost, {"amplitude": np.float64(1.0), "viscosity": np.float64(0.01)}, {"grad": "jax"}


case("fluid, Burgers' equation", "phiflow")(fluid)
case("fluid, a stopped gradient", "phiflow", "disconnected", forgotten=True)(fluid)


def heat(transposed=True):
    """Return a rod with convection, implicit steps and a handwritten adjoint; theta is the source at 50 places."""
    from scipy.linalg import lu_factor, lu_solve

    n, steps = 50, 20
    a = np.eye(n) * 1.4 - np.eye(n, k=1) * 0.1 - np.eye(n, k=-1) * 0.3
    factors = lu_factor(a)

    def rollout(source):
        u = np.zeros(n)
        for _ in range(steps):
            u = lu_solve(factors, u + 0.1 * source)
        return u

    def cost(source):
        return float(((rollout(source) - 0.2) ** 2).sum())

    def grad(source):
        adjoint, total = 2 * (rollout(source) - 0.2), np.zeros(n)
        for _ in range(steps):
            adjoint = lu_solve(factors, adjoint, trans=1 if transposed else 0)
            total = total + 0.1 * adjoint
        return total

    return cost, np.random.default_rng(0).random(n), {"grad": grad}


case("heat and convection, handwritten adjoint", "scipy")(heat)
case("heat and convection, matrix not transposed", "scipy", *WRONG, transposed=False)(heat)

C_CODE = """#include <math.h>
double cost(const double *x) { double q = x[0], v = x[1]; for (int i = 0; i < 200; i++) { v -= 0.01 * x[2] * sin(q); q += 0.01 * v; }
  return q * q; }
void grad(const double *x, double *g) { double q[201], v = x[1]; q[0] = x[0];
  for (int i = 0; i < 200; i++) { v -= 0.01 * x[2] * sin(q[i]); q[i + 1] = q[i] + 0.01 * v; }
  double dq = 2 * q[200], dv = 0, dk = 0;
  for (int i = 199; i >= 0; i--) { dv += 0.01 * dq; dk SIGN= 0.01 * sin(q[i]) * dv; dq -= 0.01 * x[2] * cos(q[i]) * dv; }
  g[0] = dq; g[1] = dv; g[2] = dk; }
"""


def c_code(sign="-"):
    place = Path(tempfile.mkdtemp())
    (place / "code.c").write_text(C_CODE.replace("SIGN", sign))
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", place / "code.so", place / "code.c", "-lm"], check=True)
    library = ctypes.CDLL(str(place / "code.so"))
    array = np.ctypeslib.ndpointer(np.float64, flags="C")
    library.cost.restype, library.cost.argtypes, library.grad.argtypes = ctypes.c_double, [array], [array, array]

    def grad(x):
        out = np.zeros(3)
        library.grad(np.ascontiguousarray(x, dtype=float), out)
        return out

    return lambda x: library.cost(np.ascontiguousarray(x, dtype=float)), [0.7, 0.3, 9.0], {"grad": grad}


case("C by ctypes", "numpy")(c_code)
case("C by ctypes, a sign wrong", "numpy", "wrong_factor", sign="+")(c_code)


class Unit:
    """A co-simulation unit with the calls of an FMU: parameters, steps, outputs and directional derivatives."""

    def __init__(self):
        self.instantiate()

    def instantiate(self):
        self.parameters, self.state, self.slopes = np.array([1.0, 0.5]), np.array([0.7, 0.0]), np.zeros((2, 2))

    def set_real(self, values):
        self.parameters = np.array(values, dtype=float)

    def do_step(self, dt):
        k, c = self.parameters
        (q, v), s = self.state, self.slopes
        self.slopes = s + dt * np.array([s[1], -k * np.cos(q) * s[0] - c * s[1] + [-np.sin(q), -v]])
        self.state = self.state + dt * np.array([v, -k * np.sin(q) - c * v])


def unit(is_reset=True):
    fmu = Unit()

    def run(x):
        if is_reset:
            fmu.instantiate()
        fmu.set_real(x)
        for _ in range(100):
            fmu.do_step(0.02)
        return fmu

    return lambda x: run(x).state[0] ** 2, [2.0, 0.5], {"grad": lambda x: 2 * run(x).state[0] * fmu.slopes[0]}


case("co-simulation unit, as an FMU", "numpy")(unit)
case("co-simulation unit that is not reset", "numpy", "nondeterministic", is_reset=False)(unit)


@case("gymnasium CartPole, a linear policy", "gymnasium", "staircase", "jumps", "jump")
def cartpole():
    import gymnasium

    env = gymnasium.make("CartPole-v1")

    def cost(x):
        state, _ = env.reset(seed=0)
        total = 0.0
        for _ in range(60):
            state, _, _, _, _ = env.unwrapped.step(int(state @ x > 0))
            total += float(state[2] ** 2)
        return total

    return cost, [0.1, 0.2, 1.0, 0.5], {}


def pendulum(clipped=True):
    """Return gymnasium's pendulum under a linear policy, with a handwritten derivative with or without its clip."""
    import gymnasium

    env = gymnasium.make("Pendulum-v1").unwrapped

    def rollout(x, slope=False):
        env.reset(seed=0)
        env.state, env.last_u = np.array([1.0, 0.0]), None
        d, total, dtotal = np.zeros((2, 2)), 0.0, np.zeros(2)
        for _ in range(15):
            q, v = env.state
            u = x[0] * q + x[1] * v
            du = x[0] * d[0] + x[1] * d[1] + np.array([q, v])
            du = du * (abs(u) < 2.0) if clipped else du
            env.step(np.array([u]))
            dv = d[1] + (15.0 * np.cos(q) * d[0] + 3.0 * du) * 0.05
            d = np.array([d[0] + dv * 0.05, dv])
            total, dtotal = total + env.state[0] ** 2, dtotal + 2 * env.state[0] * d[0]
        return dtotal if slope else float(total)

    return rollout, [-1.8, -0.5], {"grad": lambda x: rollout(x, True)}


case("gymnasium Pendulum, handwritten derivative", "gymnasium")(pendulum)
case("gymnasium Pendulum, its clip forgotten", "gymnasium", *WRONG, clipped=False)(pendulum)


def taichi_spring(overwritten=False):
    import taichi as ti

    ti.init(arch=ti.cpu, default_fp=ti.f64, log_level=ti.ERROR, offline_cache=False)
    steps = 20
    x, v = (ti.field(ti.f64, steps + 1, needs_grad=True) for _ in range(2))
    loss = ti.field(ti.f64, (), needs_grad=True)

    @ti.kernel
    def step(a: int, b: int):
        for _ in range(1):
            v[b] = v[a] - 0.05 * 9.0 * ti.sin(x[a])
            x[b] = x[a] + 0.05 * v[b]

    @ti.kernel
    def end(a: int):
        loss[None] = x[a] ** 2

    def rollout(theta, slope=False):
        x[0], v[0] = theta
        with ti.ad.Tape(loss, validation=False):
            for t in range(steps):
                step(0, 0) if overwritten else step(t, t + 1)
            end(0 if overwritten else steps)
        return [x.grad[0], v.grad[0]] if slope else loss[None]

    return rollout, [0.7, 0.3], {"grad": lambda x: rollout(x, True)}


case("Taichi kernels", "taichi")(taichi_spring)
case("Taichi kernels, state overwritten", "taichi", *WRONG, "nan_gradient", overwritten=True)(taichi_spring)


# ------------------------------------------------------------------------------------------------ the table


def said(cause: str) -> str:
    """Return a cause as the table states it."""
    return "right" if cause in RIGHT else cause


def record(name: str) -> None:
    """Run one case and print its row."""
    import bench
    from bench.measure.timing import peak_memory_mb
    from bench.report.text import duration

    one = CASES[name]
    cost, theta, settings = one.make()
    report = bench.examine(cost, theta, progress=False, name=name, **settings)
    print(report, file=sys.stderr)
    named = report.cause in one.expected and (report.cause in RIGHT) == (report.status == 0)
    memory = peak_memory_mb() * 2**20 / 1e9
    found = report.cause if report.status else f"right ({report.cause})"
    row = [
        name, f"{one.library} {metadata.version(one.library)}", said(one.expected[0]),
        found, "yes" if named else "no",
        duration(report.seconds + report.compile_s), duration(report.compile_s),
        f"{report.costs:,} + {report.gradients:,}", f"{memory:.2f}",
    ]  # fmt: skip
    print(MARK + json.dumps(row), flush=True)


def run(name: str) -> list[str]:
    """Return the row of a case that runs in a process of its own."""
    one = CASES[name]
    rest = ["-"] * (len(HEAD) - 4)
    expected = said(one.expected[0])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    words = [sys.executable, __file__, "--record", name]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT, env=environment)
    except subprocess.TimeoutExpired:
        return [name, one.library, expected, f"no end after {LIMIT} s", *rest]
    text, _, row = done.stdout.partition(MARK)
    print(f"=== {name}\n{text}{done.stderr}", file=sys.stderr, flush=True)
    if not row:
        last = (done.stderr.strip().splitlines() or ["no report"])[-1]
        return [name, one.library, expected, f"failed: {last[:100]}", *rest]
    return json.loads(row.splitlines()[0])


def main(words: list[str]) -> int:
    """Write the table of all cases, or of those named."""
    if words[:1] == ["--record"]:
        record(words[1])
        return 0
    out = [Path(word) for word in words if word.endswith(".md")]
    wanted = [word for word in words if not word.endswith(".md")]
    chosen = [name for name in CASES if not wanted or any(part.lower() in name.lower() for part in wanted)]
    rows = {}
    for name in chosen:
        rows[name] = run(name)
        print(f"| {' | '.join(rows[name])} |", flush=True)
        for path in out:
            write(path, rows)
    return int(any(row[4] != "yes" for row in rows.values()))


def write(path: Path, rows: dict[str, list[str]]) -> None:
    """Write rows into the table of a file, in the order of the cases; the rows of other cases stay."""
    before, begin, rest = path.read_text().partition(BEGIN)
    old, end, after = rest.partition(END)
    lines = {line.split("|")[1].strip(): line for line in old.splitlines() if line.startswith("|")}
    lines |= {name: f"| {' | '.join(cells)} |" for name, cells in rows.items()}
    head = [f"| {' | '.join(cells)} |" for cells in (HEAD, ["---"] * len(HEAD))]
    table = "\n".join([*head, *(lines[name] for name in CASES if name in lines)])
    path.write_text(f"{before}{begin}{table}\n{end}{after}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
