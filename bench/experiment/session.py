"""The session that a study measures cells with: compiled problems and reference gradients, shared by a run's cells."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.keys import fingerprint
from bench.measure.reference import Reference
from bench.model import Backend, Compilations, Problem


class Problems:
    """The problems used last, shared by cells with the same program and backend, and the count of compilations."""

    KEPT = 4

    def __init__(self, folder: Path | None = None) -> None:
        self.compilations = Compilations(folder)
        self._kept: dict[tuple[str, str], tuple[Problem, dict[str, bytes]]] = {}
        """Problems, each with the content of its arrays when it was compiled."""

    def of(self, backend: Backend, cell: Cell) -> Problem:
        """Return the problem of the cell's program on ``backend``, compiled if it is not cached.

        A problem whose arrays a cell has changed is compiled again.
        """
        key = (fingerprint(backend), cell.program_key)
        problem, before = self._kept.pop(key, (None, {}))
        if problem is None or before.items() - _arrays(problem).items():
            problem = backend.compile(cell.program())
            problem.compilations, problem.provides = self.compilations, backend.provides
            before = _arrays(problem)
        self._kept[key] = problem, before
        if len(self._kept) > self.KEPT:
            del self._kept[next(iter(self._kept))]
        return problem


def _arrays(problem: Problem) -> dict[str, bytes]:
    """Return the content of the arrays, and of the lists of arrays, in the attributes of a problem and of its program."""
    content = {}
    for name, value in [*vars(problem).items(), *vars(problem.program).items()]:
        parts = value if isinstance(value, list | tuple) else [value]
        if arrays := [part.tobytes() for part in parts if isinstance(part, np.ndarray)]:
            content[name] = b"".join(arrays)
    return content


class ReferenceSource(Protocol):
    """Reference gradients by cell."""

    def of(self, cell: Cell) -> Reference:
        """Return the reference gradient of a cell, computed or stored; raises the errors of its computation."""


class Session:
    """The compiled problems and reference gradients that the cells of one run share; :mod:`bench.run.session` opens one."""

    experiment: Experiment
    problems: Problems
    references: ReferenceSource

    def problem(self, cell: Cell) -> Problem:
        """Return the cell's program, compiled on its backend."""
        return self.problems.of(cell.backend, cell)

    @property
    def compilations(self) -> Compilations:
        """Compilations of the run's problems since the count was restarted."""
        return self.problems.compilations
