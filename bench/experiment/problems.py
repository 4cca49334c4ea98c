"""Compiled problems, shared by cells that run the same program on the same backend."""

from __future__ import annotations

from pathlib import Path

from bench.experiment.cell import Cell
from bench.experiment.keys import fingerprint
from bench.model import Backend, Compilations, Problem


class Problems:
    """The problems compiled last, and the count of their compilations."""

    KEPT = 4

    def __init__(self, folder: Path | None = None) -> None:
        self.compilations = Compilations(folder)
        self._kept: dict[tuple[str, str], Problem] = {}

    def of(self, backend: Backend, cell: Cell) -> Problem:
        """Return the cell's program, compiled on a backend."""
        key = (fingerprint(backend), cell.program_key)
        problem = self._kept.pop(key, None)
        if problem is None:
            problem = backend.compile(cell.program())
            problem.compilations, problem.provides = self.compilations, backend.provides
        self._kept[key] = problem
        if len(self._kept) > self.KEPT:
            del self._kept[next(iter(self._kept))]
        return problem
