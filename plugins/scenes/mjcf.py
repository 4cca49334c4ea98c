"""A robot from an MJCF file, with observation and cost from a Python file, under a policy."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from bench.model import Array, JointScene, PolicyScene, State, Unsupported, UserError, load_module, param, unknown

ROBOTS = Path(__file__).parents[1] / "robots"
"""The folder of the built-in robots."""
FUNCTIONS = ("observation", "stage_cost")
"""Functions that the Python file must define."""


class Robot(NamedTuple):
    """What an MJCF file says about a robot."""

    q: np.ndarray
    """Positions at the start, ``(n_q,)``."""
    v: np.ndarray
    """Velocities at the start, ``(n_v,)``."""
    controls: np.ndarray
    """Controls at the start, ``(n_u,)``."""
    joints: tuple[str, ...]
    """Types of the joints."""


@dataclass(frozen=True)
class Mjcf(PolicyScene, JointScene):
    """A robot from the MJCF file ``file``, as it is written, under u_t = u0 + action_scale pi(theta, o(x_t)) + sigma w_t.

    A Python file, by default beside the MJCF file and of the same name, defines ``observation(xp, q, v)``, ``(n, B)``,
    and ``stage_cost(xp, q, v, u)``, ``(B,)``, and may define ``terminal_cost(xp, q, v)``, ``has_ended(xp, q, v)`` and
    ``random_start(xp, q0, v0, e)``, which returns (q, v) from ``n_start`` standard normal numbers e. q0, v0 and u0 are
    the first keyframe if there is one, else the model's reference pose. Contacts, limits, friction, springs and
    actuators come from the file; the backend decides integrator, solver and friction cone, ``dt / substeps`` is the
    engine's time step. Orientations are unit quaternions (w, x, y, z).

    Not supported: actuators with activation states, mocap bodies, plugins.
    """

    name = "mjcf"
    neglected_effects = "the effects that its file neglects"
    continuous = False  # the force of a contact with the engine's default impedance jumps at touch-down
    requires = ("mujoco",)
    backends = ("mujoco", "mjx")

    sigma: float = param(0.05, "standard deviation of the noise on the controls, or on theta", positive=True)
    horizon: int = 10
    substeps: int = param(2, "steps of the engine per control step", positive=True)
    file: str = param("quadruped.xml", "MJCF file; PACKAGE:FILE of an installed Python package, or a built-in robot")
    functions: str = param("", "Python file with observation and cost; empty: the MJCF file's name with .py")
    action_scale: float = param(0.3, "controls per unit of the policy's output")
    theta: str = param(
        "policy", "the policy's parameters, or the velocities at the start", choices=("policy", "velocity")
    )

    @property
    def path(self) -> Path:
        """The MJCF file. Raises :class:`UserError` if there is none."""
        package, colon, inside = self.file.partition(":")
        place = _package_folder(package) / inside if colon and not Path(self.file).exists() else Path(self.file)
        for path in (place.expanduser(), ROBOTS / self.file):
            if path.is_file():
                return path.resolve()
        built_in = sorted(path.name for path in ROBOTS.glob("*.xml"))
        if len(place.parts) == 1:
            raise unknown("MJCF file, or built-in robot:", self.file, built_in)
        raise UserError(f"mjcf.file={self.file}: this file does not exist; built-in robots are {', '.join(built_in)}")

    @property
    def module(self) -> ModuleType:
        """The module with observation and cost. Raises :class:`UserError` if it lacks one of them."""
        place = Path(self.functions).expanduser() if self.functions else self.path.with_suffix(".py")
        found = next(filter(Path.is_file, (place, ROBOTS / place.name)), None)
        if found is None:
            raise UserError(
                f"mjcf.functions: the file {place} does not exist; it should have the functions {', '.join(FUNCTIONS)}"
            )
        module = load_module(str(found))
        for name in FUNCTIONS:
            if not callable(getattr(module, name, None)):
                raise UserError(f"{found} defines no function {name}: required are {', '.join(FUNCTIONS)}")
        return module

    @property
    def robot(self) -> Robot:
        """The robot's start and joints."""
        robot = _read(self.path, self.path.stat().st_mtime_ns)
        if not len(robot.controls) and self.theta == "policy":
            raise UserError(f"mjcf.file={self.path} has no actuators for a policy: use theta=velocity")
        if not len(robot.controls) and self.noise == "action":
            raise UserError(f"mjcf.file={self.path} has no actuators for noise=action: use noise=parameter")
        return robot

    def files(self) -> tuple[Path, ...]:
        """Return all files that decide the robot's motion and cost. If one changes, the scene's cells run again."""
        return (Path(str(self.module.__file__)), *_model_files(self.path))

    def model_file(self) -> Path:
        _ = self.robot
        return self.path

    def mjcf(self) -> str:
        """Raise :class:`Unsupported`: the model is a file."""
        raise Unsupported("the model of scene mjcf is a file, which only backends mujoco and mjx read")

    # ----------------------------------------------------------------------------------------------- dimensions

    @property
    def joints(self) -> tuple[str, ...]:  # type: ignore[override]
        """The types of the joints."""
        return self.robot.joints

    @property
    def n_q(self) -> int:  # type: ignore[override]
        """Length of the positions."""
        return len(self.robot.q)

    @property
    def n_v(self) -> int:
        """Length of the velocities."""
        return len(self.robot.v)

    @property
    def n_u(self) -> int:  # type: ignore[override]
        """Number of actuators."""
        return len(self.robot.controls)

    @property
    def exogenous(self) -> int:  # type: ignore[override]
        """Number of standard normal numbers of a random start: ``n_start`` of the Python file, or 0."""
        return int(getattr(self.module, "n_start", 0)) if self.theta == "policy" else 0

    @property
    def n_observations(self) -> int:  # type: ignore[override]
        """Length of the observation."""
        q, v = (part[:, None] for part in self.robot[:2])
        return len(self.module.observation(np, q, v))

    # --------------------------------------------------------------------------------------------------- physics

    def theta0(self) -> np.ndarray:
        return super().theta0() if self.theta == "policy" else self.robot.v.copy()

    def initial_state(self, xp: Any, theta: Array) -> State:
        q, v = self._start(xp, theta)
        return State(q, v if self.theta == "policy" else theta)

    def random_start(self, xp: Any, e: Array) -> State:
        state = self._optional("random_start", xp, *self._start(xp, e), e)
        return State(*state) if state else super().random_start(xp, e)

    def _start(self, xp: Any, like: Array) -> list[Array]:
        """Return the robot's own positions and velocities, with the columns and type of an array ``(n, B)``."""
        return [xp.asarray(part[:, None], dtype=like.dtype) + 0.0 * like[:1] for part in self.robot[:2]]

    def observation(self, xp: Any, q: Array, v: Array) -> Array:
        return self.module.observation(xp, q, v)

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array:
        """Return u0 + action_scale pi(theta, o), or u0 if theta is the velocities at the start, ``(n_u, B)``."""
        if self.theta == "velocity":
            return self._controls(xp, 0.0 * q[:1])
        return self._controls(xp, self.plugin.act(xp, theta, self.observation(xp, q, v)))

    def controls_of(self, xp: Any, action: Array) -> Array:
        """Return u0 + action_scale tanh(action), since actuators have limits, beyond which a derivative is 0."""
        return self._controls(xp, xp.tanh(action))

    def _controls(self, xp: Any, change: Array) -> Array:
        return xp.asarray(self.robot.controls[:, None], dtype=change.dtype) + self.action_scale * change

    def stage_cost(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Return the cost of a step of the Python file; 0 after the end."""
        cost = self.module.stage_cost(xp, q, v, u)
        ended = self.has_ended(xp, q, v)
        return cost if ended is None else xp.where(ended, 0.0 * cost, cost)

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Return the terminal cost of the Python file, or 0."""
        cost = self._optional("terminal_cost", xp, q, v)
        return 0.0 * v[0] if cost is None else cost

    def has_ended(self, xp: Any, q: Array, v: Array) -> Array | None:
        """Return whether rollouts have ended, by the Python file; None if they never do."""
        return self._optional("has_ended", xp, q, v)

    def _optional(self, name: str, *arguments: Any) -> Any:
        function = getattr(self.module, name, None)
        return function and function(*arguments)


@cache
def _read(path: Path, changed: int) -> Robot:
    """Return the robot of an MJCF file that was last changed at the time ``changed``."""
    import mujoco

    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise UserError(f"mjcf.file={path} cannot be read: {error}") from None
    for count, what in (
        (model.na, "actuators with activation states"),
        (model.nmocap, "mocap bodies"),
        (model.nplugin, "plugins"),
    ):
        if count:
            raise UserError(f"mjcf.file={path} has {what}, which scene mjcf does not support")
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    return Robot(
        data.qpos,
        data.qvel,
        data.ctrl,
        tuple(mujoco.mjtJoint(kind).name.removeprefix("mjJNT_").lower() for kind in model.jnt_type),
    )


def _model_files(path: Path) -> list[Path]:
    """Return an MJCF file and the files that it names, and those that these name."""
    paths, waiting = [], [path]
    while waiting:
        current = waiting.pop()
        if current.is_file() and current not in paths:
            paths.append(current)
            text = current.read_text() if current.suffix == ".xml" else ""
            folders = re.findall(r'(?:meshdir|texturedir|assetdir)\s*=\s*"([^"]*)"', text)
            for name in re.findall(r'\bfile\s*=\s*"([^"]*)"', text):
                waiting += [(current.parent / folder / name).resolve() for folder in ("", *folders)]
    return paths


def _package_folder(package: str) -> Path:
    import importlib.util

    spec = importlib.util.find_spec(package) if package.isidentifier() else None
    folders = spec and spec.submodule_search_locations
    if not folders:
        raise UserError(f"mjcf.file: the Python package '{package}' is not installed: pip install {package}")
    return Path(folders[0])
