"""The contract of a backend, which executes and differentiates programs."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from bench.host.parameters import Plugin, param
from bench.model.problem import Problem
from bench.model.program import Program

CAPABILITIES = frozenset({"value", "grad", "score", "surrogate", "root", "physics", "simulator"})
"""The capabilities that a backend may provide."""


@dataclass(frozen=True)
class Backend(Plugin):
    """Executes a program and differentiates it."""

    kind: ClassVar[str] = "backends"
    provides: ClassVar[frozenset[str]] = frozenset({"value", "grad", "score"})
    """Capabilities, a subset of :data:`CAPABILITIES`.

    - ``surrogate``: computes the gradient that a contact law declares in place of the derivative.
    - ``simulator``: runs only users' own simulators, see :class:`CallableScene`.
    - ``physics``: steps a scene's :meth:`~EngineTwin.mjcf` twin with the engine's integrator and contact solver. Its
      programs differ from other backends' programs and need their own reference gradients.
    """
    compiles: ClassVar[bool] = False
    """Whether each new batch shape requires a compilation, so that estimates are best computed one by one."""
    reference_rank: ClassVar[int | None] = None
    """Priority for computing reference gradients, smallest first; None: never used."""

    dtype: str = param("float64", "floating-point type of the simulation", choices=("float64", "float32"))

    @abstractmethod
    def compile(self, program: Program) -> Problem:
        """Return the program compiled as a problem."""

    def library_versions(self) -> dict[str, str]:
        """Return the versions of the libraries of another Python that computes, by name; none by default."""
        return {}

    def own_refusal(self, program: Program) -> str | None:
        """Return why this backend's own limits exclude the program, or None."""
        return None

    def refusal(self, program: Program) -> str | None:
        """Return why this backend cannot run the program, or None. Checks the scene's limits and the backend's own."""
        only = program.scene.backends
        if only and self.name not in only:
            return f"scene {program.scene.name} runs on {' and '.join(only)} only"
        if program.needs_root and "root" not in self.provides:
            part = next(p for p in (program.contact, program.integrator) if p is not None and p.needs_root)
            return f"{part.name} solves an equation each step, and backend {self.name} has no root finder"
        if not program.needs <= self.provides:
            return f"{program.scene.name} runs only in physics engines, and backend {self.name} is not one"
        return self.own_refusal(program)
