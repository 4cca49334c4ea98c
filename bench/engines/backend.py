"""The contract of a backend whose engine runs in another Python."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from bench.engines import environments, server, twin
from bench.engines.problem import EngineProblem
from bench.engines.process import EngineModel
from bench.errors import Unavailable, Unsupported
from bench.host.parameters import values
from bench.model import Backend, EngineTwin, MechanicalScene, Problem, Program, adjoint, param


@dataclass(frozen=True)
class EngineBackend(Backend):
    """A backend whose steps an engine in a Python of its own computes; :mod:`bench.engines.server` has the engine's part.

    The engine's file is in a folder ``engines``, from which the harness imports nothing.
    """

    uses = (adjoint,)
    requires = ("mujoco",)
    provides = frozenset({"value", "grad", "score", "physics"})

    file: ClassVar[str]
    """The engine's file, relative to the folder of the backend's own file, such as ``engines/my_engine.py``."""
    libraries: ClassVar[tuple[str, ...]] = ()
    """Distributions that the engine needs. Rows have their versions."""
    laws: ClassVar[tuple[str, ...]] = ("penalty",)
    """Names of the contact laws that the engine's contacts stand for."""
    damping_mode: ClassVar[str | None] = None
    """The law's ``damping_mode`` that the engine's damper stands for; empty: no damper; None: any."""
    integrator: ClassVar[str] = "semi_implicit_euler"
    """Name of the integrator that the engine's step stands for."""

    own_contact: ClassVar[bool] = False
    """Whether contacts are the engine's own, with at most the law's stiffness and damping, and not compared with the law."""

    solver_error: ClassVar[float] = 0.0
    """Relative difference that an iterative solver of contact forces, which stops early, causes in costs."""

    reads_mjcf: ClassVar[bool] = False
    """Whether the engine reads the twin's MJCF itself, and so has its ground, which may not be z = 0."""

    has_friction: ClassVar[bool] = False
    """Whether it runs contacts with friction."""

    dtype: str = param("float64", "floating-point type of the simulation", choices=("float64",))
    python: str | None = param(
        None, "Python of the engine's environment; null: the one that `bench engines install` makes"
    )

    def compile(self, program: Program) -> Problem:
        """Return the program as a problem; the engine is started when it is first called."""
        if reason := self.own_refusal(program):
            raise Unsupported(reason)
        if reason := self.unavailable_reason():
            raise Unavailable(reason)
        python = self.python or str(environments.python_of(self.name))
        return EngineProblem(program, EngineModel(self.name, python, self.files()[0], self.describe(program)))

    def unavailable_reason(self) -> str | None:
        """Return why the engine's environment cannot be used, with the command that makes it, or None."""
        return environments.missing(self.name, self.python, self.libraries)

    def library_versions(self) -> dict[str, str]:
        """Return the versions of the engine's Python and libraries, by name; empty if the environment is missing."""
        try:
            return environments.library_versions(self.python or str(environments.python_of(self.name)), self.libraries)
        except Unavailable:
            return {}

    def own_refusal(self, program: Program) -> str | None:
        """Return why the engine cannot run the program, or None."""
        if reason := self.model_refusal(self.name, program, "", self.integrator, self.laws, self.damping_mode):
            return reason
        try:
            model = twin.read(program.scene.mjcf())  # type: ignore[attr-defined]
            if not self.has_friction and any(contact["friction"] for contact in model["contacts"]):
                return f"{self.name} runs contacts without friction only"
            if not (model["is_level"] or self.reads_mjcf):
                return f"{self.name}'s ground is z = 0"
            return self.twin_refusal(program, model)
        except Unsupported as error:
            return str(error)

    @staticmethod
    def model_refusal(
        name: str, program: Program, own: str, integrator: str, laws: tuple[str, ...], damping_mode: str | None
    ) -> str | None:
        """Return why the engine ``name`` has no model of a program, or None.

        Its integrator ``own`` replaces ``integrator``, its contacts replace ``laws`` with dampers of ``damping_mode``.
        """
        scene, law, step = program.scene, program.contact, program.integrator
        if not isinstance(scene, EngineTwin) or not isinstance(scene, MechanicalScene):
            return f"scene {scene.name} has no MJCF twin"
        if program.decision.names:
            return f"{name} does not differentiate by parameters of its model: theta={list(program.decision.names)}"
        if step is None or step.name != integrator:
            return (
                f"{name} uses its own integrator{own}, which replaces {integrator}, not {step.name if step else 'none'}"
            )
        if law is None:
            return None
        if law.name not in laws:
            return f"{name} uses its own contact model, which replaces {' and '.join(laws)}, not {law.name}"
        mode = getattr(law, "damping_mode", "")
        if damping_mode is None or mode == damping_mode or not getattr(law, "damping", 0.0):
            return None
        return f"{name} supports {f'damping_mode={damping_mode}' if damping_mode else 'no damping'} only, not {mode}"

    def twin_refusal(self, program: Program, model: dict[str, Any]) -> str | None:
        """Return why the engine cannot run a program with the twin ``model`` of :func:`bench.engines.twin.read`, or None."""
        return None

    def describe(self, program: Program) -> dict[str, Any]:
        """Return what the engine's ``Model`` is built from, as JSON: the twin, the contact law and all parameters."""
        scene, law = program.scene, program.contact
        assert isinstance(scene, MechanicalScene)
        assert isinstance(scene, EngineTwin)
        return {
            "scene": scene.name,
            "parameters": values(scene),
            "backend": values(self),
            "dt": scene.dt,
            "horizon": scene.horizon,
            "mjcf": scene.mjcf(),
            "contact": {} if law is None else {"name": law.name, **values(law)},
            **twin.read(scene.mjcf()),
        }

    @classmethod
    def files(cls) -> list[Path]:
        """Return the engine's file and the server's, which run in the engine's Python."""
        return [Path(inspect.getfile(cls)).parent / cls.file, Path(server.__file__)]
