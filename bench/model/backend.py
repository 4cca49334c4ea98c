"""Backends: they execute a program and differentiate it."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from bench.model.parameters import Plugin, param
from bench.model.problem import Problem
from bench.model.program import Program

CAPABILITIES = frozenset({"value", "grad", "score", "explicit", "surrogate", "root", "physics", "simulator"})
"""What a backend may provide."""


@dataclass(frozen=True)
class Backend(Plugin):
    """Executes a program and differentiates it."""

    kind: ClassVar[str] = "backends"
    provides: ClassVar[frozenset[str]] = frozenset({"value", "grad", "score"})
    """Capabilities, out of :data:`CAPABILITIES`.

    With ``explicit`` it differentiates the cost by theta under given actions, see :meth:`Problem.explicit`. With
    ``surrogate`` it gives the gradients that a contact law declares in place of the derivative.

    With ``simulator`` it runs only simulators of the user's own, see :class:`CallableScene`.

    With ``physics`` the backend steps a scene's :meth:`~EngineTwin.mjcf` twin by an integrator and a contact solver of
    its own, so its programs differ from those of other backends and need reference gradients of their own.
    """
    compiles: ClassVar[bool] = False
    """Whether each new batch shape costs a compilation, so that estimates are best made one by one."""
    reference_rank: ClassVar[int | None] = None
    """Order in which backends are asked to compute reference gradients, smallest first; None: never."""

    dtype: str = param("float64", "floating-point type of the simulation", choices=("float64", "float32"))

    @abstractmethod
    def compile(self, program: Program) -> Problem:
        """Return the program made ready to run."""

    def unsupported_reason(self, program: Program) -> str | None:
        """Return why this backend cannot run the program, or None."""
        return None

    def incompatibility(self, program: Program) -> str | None:
        """Return why this backend cannot run the program: its own or the scene's refusal, or a lack; or None."""
        only = program.scene.backends
        if only and self.name not in only:
            return f"scene {program.scene.name} runs on {' and '.join(only)} only"
        if program.needs_root and "root" not in self.provides:
            part = next(p for p in (program.contact, program.integrator) if p is not None and p.needs_root)
            return f"{part.name} solves an equation each step, backend {self.name} has no root finder"
        if not program.needs <= self.provides:
            return f"{program.scene.name} runs only in physics engines, and backend {self.name} is not one"
        return self.unsupported_reason(program)
