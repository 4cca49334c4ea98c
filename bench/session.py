"""What the cells of one run share: compiled problems and reference gradients."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench import reference
from bench.contracts import Backend, Problem
from bench.grid import Cell, Experiment, ranked_backends, reference_backends
from bench.reference import Reference

__all__ = ["Problems", "References", "Session", "reference_backends"]


class Problems:
    """The problems compiled last, shared by cells that run the same program on the same backend."""

    KEPT = 4

    def __init__(self) -> None:
        self._kept: dict[tuple[Backend, str], Problem] = {}

    def of(self, backend: Backend, cell: Cell) -> Problem:
        """The cell's program on a backend."""
        key = (backend, cell.program_key)
        problem = self._kept.pop(key, None) or backend.compile(cell.program())
        self._kept[key] = problem
        if len(self._kept) > self.KEPT:
            del self._kept[next(iter(self._kept))]
        return problem


class References:
    """Reference gradients, each computed once and kept on disk beside the experiments."""

    def __init__(self, experiment: Experiment, problems: Problems) -> None:
        self._problems = problems
        self._directory = experiment.results_dir / "references"
        self._budget = (experiment.reference_samples, experiment.reference_tolerance)
        self._known: dict[str, Reference] = {}

    def stored(self, cell: Cell) -> bool:
        """Whether the reference of the cell's program is on disk."""
        return self._path(cell).exists()

    def of(self, cell: Cell) -> Reference:
        """The reference of the cell's program, on the best backend that can run it."""
        key = cell.reference_key
        if key not in self._known:
            found = reference.load(self._path(cell))
            if found is None:
                backend = cell.reference_backend
                problem = self._problems.of(backend, cell)
                found = reference.certify(problem, backend.provides, *self._budget, self._stood_for(cell))
                reference.save(found, self._path(cell))
            self._known[key] = found
        return self._known[key]

    def _path(self, cell: Cell) -> Path:
        return self._directory / f"{cell.reference_key}.parquet"

    def _stood_for(self, cell: Cell) -> np.ndarray | None:
        """The gradient that the program's own, at w = 0, should be: that of the physics, where the scene knows it.

        For a backend with physics of its own and a scene that does not, that of the scene's program.
        """
        program, theta = cell.program(), cell.scene.theta0()
        physical = cell.scene.physical_gradient()
        if physical is None and "physics" in cell.backend.provides:
            for backend in ranked_backends(cell):
                if "grad" in backend.provides:
                    return self._problems.of(backend, cell).grad(theta, np.zeros((program.n_noise, 1)))[:, 0]
        return physical


class Session:
    """The problems and references of one run."""

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self.problems = Problems()
        self.references = References(experiment, self.problems)

    def problem(self, cell: Cell) -> Problem:
        """The cell's program on its backend."""
        return self.problems.of(cell.backend, cell)
