"""Agreement of the gradients through MJX's converged solver with differences and forward mode, on 20 mechanisms.

All mechanisms are in one model, far from each other, so that each combination of cone and solver compiles one program. Each
has its own cost, a random linear function of its final state, and the derivative is along a random change of its initial
velocity.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np

STEPS = 20
DT = 0.004
DIFFERENCES = (1e-5, 1e-6, 1e-7)
"""Steps of the central differences [m/s, rad/s]; the closest one to a derivative counts, as in a step-size sweep."""
BOX = '<geom name="{name}" type="box" size=".1 .08 .06" mass="1"/>'
BALL = '<geom name="{name}" type="sphere" size=".1" mass="1"/>'
ROD = '<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".5" contype="0" conaffinity="0"/>'


@dataclass(frozen=True)
class Mechanism:
    """One mechanism: bodies at the origin, other elements of the model, and its initial velocity."""

    name: str
    bodies: str
    velocity: tuple[float, ...]
    pairs: str = ""
    equality: str = ""
    tendon: str = ""
    actuator: str = ""


def _floor(geom: str, friction: str = ".5 .5 .01 .01 .01", condim: int = 3, ground: str = "ground") -> str:
    return f'<pair geom1="{ground}" geom2="{geom}" condim="{condim}" friction="{friction}"/>'


def _free(name: str, geom: str, height: float, tilt: str = "0 0 0") -> str:
    return f'<body name="{name}" pos="0 0 {height}" euler="{tilt}"><freejoint/>{geom.format(name=name)}</body>'


def _hinge(name: str, options: str = "", inner: str = "", x: float = 0.0) -> str:
    return (
        f'<body name="{name}" pos="{x} 0 1"><joint name="{name}" type="hinge" axis="0 1 0" {options}/>{ROD}'
        f'<site name="{name}" pos=".3 0 0"/>{inner}</body>'
    )


def _slide(name: str, options: str) -> str:
    return f'<body name="{name}" pos="0 0 1"><joint name="{name}" type="slide" axis="1 0 .2" {options}/>{ROD}</body>'


MECHANISMS = (
    Mechanism("free flight", _free("flying", BOX, 3.0), (1.0, 0.3, 0.5, 2.0, -1.0, 3.0)),
    Mechanism("bouncing ball", _free("bouncing", BALL, 0.104), (0.2, 0.1, -1.0, 0.3, 0.2, 0.1), _floor("bouncing", condim=1)),
    Mechanism("sticking ball", _free("sticking", BALL, 0.0999), (0.0, 0.0, -0.01, 0.0, 0.0, 0.02), _floor("sticking", "1 1 .01 .01 .01")),
    Mechanism("sliding ball", _free("sliding", BALL, 0.0995), (2.0, 0.5, 0.0, 0.0, 0.0, 0.0), _floor("sliding")),
    Mechanism("spinning ball, torsional friction", _free("spinning", BALL, 0.0995), (0.3, 0.1, 0.0, 0.0, 0.0, 5.0), _floor("spinning", condim=4)),
    Mechanism("rolling ball, rolling friction", _free("rolling", BALL, 0.0995), (0.5, 0.2, 0.0, -2.0, 5.0, 0.3), _floor("rolling", condim=6)),
    Mechanism("resting box", _free("resting", BOX, 0.0598), (0.01, 0.0, 0.0, 0.0, 0.01, 0.0), _floor("resting", "1 1 .01 .01 .01")),
    Mechanism("sliding box", _free("shoved", BOX, 0.0598), (1.5, 0.7, 0.0, 0.0, 0.0, 1.0), _floor("shoved")),
    Mechanism("tumbling box", _free("tumbling", BOX, 0.14, "20 30 10"), (0.5, 0.1, -1.5, 1.0, 2.0, -1.0), _floor("tumbling")),
    Mechanism("ball on a slope", _free("downhill", BALL, 0.0997), (0.1, 0.0, 0.0, 0.0, 0.0, 0.0), _floor("downhill", ".1 .1 .01 .01 .01", ground="slope")),
    Mechanism(
        "stacked balls",
        _free("lower", BALL, 0.0995) + '<body pos="0 0 .298"><joint type="slide" axis="0 0 1"/><joint type="slide" axis="1 0 0"/>'
        + BALL.format(name="upper") + "</body>",
        (0.05, 0.02, 0.0, 0.0, 0.1, 0.0, -0.1, 0.03),
        _floor("lower") + '<pair geom1="lower" geom2="upper" condim="3" friction=".5 .5 .01 .01 .01"/>',
    ),
    Mechanism("pendulum at its limit", _hinge("stopped", 'limited="true" range="-20 10"'), (4.0,)),
    Mechanism("slide at its limit", _slide("end", 'limited="true" range="-1 .02"'), (0.8,)),
    Mechanism("ball joint at its limit", f'<body pos="0 0 1"><joint type="ball" limited="true" range="0 10"/>{ROD}</body>', (1.0, 3.0, 2.0)),
    Mechanism("slipping friction loss", _hinge("slipping", 'frictionloss=".3"'), (1.0,)),
    Mechanism("held by friction loss", _hinge("held", 'frictionloss="5"'), (0.001,)),
    Mechanism(
        "loop closed by connect", _hinge("crank", "", _hinge("rod").replace('pos="0.0 0 1"', 'pos=".3 0 0"')) + _hinge("rocker", "", x=0.6),
        (0.5, -1.0, -0.5), equality='<connect site1="rod" site2="rocker"/>',
    ),
    Mechanism(
        "coupled joints", _hinge("first") + _hinge("second"), (1.0, 0.5), equality='<joint joint1="first" joint2="second" polycoef="0 1.5 .2 0 0"/>',
    ),
    Mechanism(
        "limited tendon", _hinge("left") + _hinge("right"), (2.0, 1.0),
        tendon='<fixed name="strap" limited="true" range="-1 .05" stiffness="3" damping=".1" frictionloss=".05">'
        '<joint joint="left" coef="1"/><joint joint="right" coef="-.7"/></fixed>',
    ),
    Mechanism(
        "driven cart with a pushed ball", '<body pos="-.202 0 .1"><joint name="cart" type="slide" axis="1 0 0" damping=".5"/>' + BALL.format(name="cart")
        + "</body>" + _free("pushed", BALL, 0.0995), (1.3, 0.02, 0.01, 0.0, 0.0, 0.1, 0.0),
        _floor("pushed") + '<pair geom1="cart" geom2="pushed" condim="3" friction=".5 .5 .01 .01 .01"/>',
        actuator='<position joint="cart" kp="50" kv="2"/>',
    ),
)  # fmt: skip


def world(
    cone: str, solver: str, iterations: int, mechanisms: tuple[Mechanism, ...] = MECHANISMS, integrator: str = "Euler"
) -> Any:
    """Return the ``mujoco.MjModel`` of all mechanisms, each 20 m from the next."""
    import mujoco

    bodies = "".join(f'<frame pos="0 {20 * i} 0">{mechanism.bodies}</frame>' for i, mechanism in enumerate(mechanisms))
    slope = [20 * i for i, mechanism in enumerate(mechanisms) if "slope" in mechanism.pairs]
    slopes = "".join(
        f'<geom name="slope" type="plane" size="1 1 1" pos="0 {y} 0" euler="0 4 0" contype="0" conaffinity="0"/>'
        for y in slope
    )

    pairs = "".join(mechanism.pairs for mechanism in mechanisms)
    if cone == "elliptic":  # MJX has no contacts without friction beside elliptic cones
        pairs = pairs.replace('condim="1"', 'condim="3"')

    def joined(part: str) -> str:
        return f"<{part}>{''.join(getattr(mechanism, part) for mechanism in mechanisms)}</{part}>"

    return mujoco.MjModel.from_xml_string(f"""<mujoco>
      <option timestep="{DT}" cone="{cone}" solver="{solver}" iterations="{iterations}"
        ls_iterations="20" integrator="{integrator}"/>
      <default><geom contype="0" conaffinity="0"/></default>
      <worldbody><geom name="ground" type="plane" size="1 1 1" contype="0" conaffinity="0"/>{slopes}{bodies}</worldbody>
      <contact>{pairs}</contact>
      {joined("equality")}{joined("tendon")}{joined("actuator")}</mujoco>""")


class Rollouts:
    """Rollouts of a model by a compiled MJX step, and derivatives chained from the step's products."""

    def __init__(self, model: Any, implicit: bool = True, reverse: bool = True, control: float = 0.3) -> None:
        import jax

        from bench.plugins import mjx_solver

        jax.config.update("jax_enable_x64", True)
        mjx = mjx_solver.library()
        traced, data = mjx.put_model(model), mjx.make_data(model)
        data = jax.tree.map(lambda leaf: leaf.astype(float) if leaf.dtype.kind == "f" else leaf, data)
        data = data.replace(ctrl=jax.numpy.full(model.nu, control))

        def step(q: Any, v: Any, warm: Any) -> Any:
            with mjx_solver.implicit() if implicit else nullcontext():
                after = mjx.step(traced, data.replace(qpos=q, qvel=v, qacc_warmstart=warm))
            return after.qpos, after.qvel, jax.lax.stop_gradient(after.qacc)

        def products(q: Any, v: Any, warm: Any, up: Any, along: Any) -> Any:
            def moved(q: Any, v: Any) -> Any:
                return step(q, v, warm)[:2]

            back = jax.vjp(moved, q, v)[1](up) if reverse else up
            return back, jax.jvp(moved, (q, v), along)[1]

        self.model = model
        self._step, self._products = jax.jit(step), jax.jit(products)

    def path(self, q: np.ndarray, v: np.ndarray, steps: int = STEPS) -> list[Any]:
        """Return the states (q, v, warm start) of a rollout."""
        states = [(q, v, np.zeros(self.model.nv))]
        for _ in range(steps):
            states.append(tuple(np.asarray(part) for part in self._step(*states[-1])))
        return states

    def derivatives(self, path: list[Any], up: tuple[np.ndarray, ...], direction: np.ndarray) -> tuple[np.ndarray, Any]:
        """Return the cost's gradient by the initial velocity in reverse mode, and the change of the last state by ``direction``."""
        none, rest = tuple(map(np.zeros_like, up)), (np.zeros(self.model.nq), np.zeros(self.model.nv))
        along: Any = (np.zeros(self.model.nq), direction)
        for state in path[:-1]:
            along = self._products(*state, none, along)[1]
        for state in path[-2::-1]:
            up = self._products(*state, up, rest)[0]
        return np.asarray(up[1]), along


def agreement(
    cone: str, solver: str, iterations: int = 100, implicit: bool = True, reverse: bool = True,
    mechanisms: tuple[Mechanism, ...] = MECHANISMS, integrator: str = "Euler",
) -> dict[str, tuple[float, float, float]]:  # fmt: skip
    """Return, by mechanism, the derivative in reverse mode, in forward mode and by the closest central difference."""
    rollouts = Rollouts(world(cone, solver, iterations, mechanisms, integrator), implicit, reverse)
    model, random = rollouts.model, np.random.default_rng(0)
    start, velocity = model.qpos0.copy(), np.concatenate([m.velocity for m in mechanisms])
    direction, *weights = (random.standard_normal(n) for n in (model.nv, model.nq, model.nv))
    sizes = [len(mechanism.velocity) for mechanism in mechanisms]
    of_velocity = np.repeat(np.arange(len(mechanisms)), sizes)
    of_position = of_velocity[model.jnt_dofadr].repeat(np.diff([*model.jnt_qposadr, model.nq]))

    def split(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.bincount(of_position, q * weights[0]) + np.bincount(of_velocity, v * weights[1])

    def last(shift: float) -> np.ndarray:
        q, v, _ = rollouts.path(start, velocity + shift * direction)[-1]
        return split(q, v)

    gradient, along = rollouts.derivatives(rollouts.path(start, velocity), tuple(weights), direction)
    reversed_ = np.bincount(of_velocity, gradient * direction) if reverse else np.full(len(sizes), np.nan)
    forward = split(*(np.asarray(part) for part in along))
    differences = np.stack([(last(h) - last(-h)) / (2 * h) for h in DIFFERENCES])
    closest = np.abs(differences - forward).argmin(axis=0)
    return {
        mechanism.name: (float(reversed_[i]), float(forward[i]), float(differences[closest[i], i]))
        for i, mechanism in enumerate(mechanisms)
    }
