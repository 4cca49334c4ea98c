"""What the cells of one run share: compiled problems and reference gradients."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench import reference, registry
from bench.contracts import Backend, Problem
from bench.grid import Cell, Experiment
from bench.program import Program
from bench.reference import Reference


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

    def of(self, cell: Cell) -> Reference:
        """The reference of the cell's program, on the best backend that can run it."""
        key = f"{cell.program_key}-{self._budget[0]}-{self._budget[1]:g}"
        if key not in self._known:
            path = self._directory / f"{key}.parquet"
            found = reference.load(path)
            if found is None:
                backend = next(reference_backends(cell))
                problem = self._problems.of(backend, cell)
                found = reference.certify(problem, backend.provides, *self._budget, self._stood_for(cell))
                reference.save(found, path)
            self._known[key] = found
        return self._known[key]

    def _stood_for(self, cell: Cell) -> np.ndarray | None:
        """The gradient that the program's own, at w = 0, should be: that of the physics, where the scene knows it.

        For a backend with physics of its own and a scene that does not, that of the scene's program.
        """
        program, theta = cell.program(), cell.scene.theta0()
        physical = cell.scene.physical_gradient()
        if physical is None and "physics" in cell.backend.provides:
            for backend in ranked_backends(program):
                if "grad" in backend.provides:
                    return self._problems.of(backend, cell).grad(theta, np.zeros((program.n_noise, 1)))[:, 0]
        return physical


def reference_backends(cell: Cell) -> Iterator[Backend]:
    """Backends able to run the cell's program for a reference, best first, the cell's own last.

    A backend with physics of its own runs a program of its own, for which it alone can speak.
    """
    if "physics" not in cell.backend.provides:
        yield from ranked_backends(cell.program())
    yield cell.backend


def ranked_backends(program: Program) -> list[Backend]:
    """The available backends that compute references and can run the program, best first."""
    ranked = []
    for entry in registry.entries()["backends"].values():
        plugin = entry.plugin
        if plugin is None or not entry.available or not issubclass(plugin, Backend) or plugin.reference_rank is None:
            continue
        backend = plugin()
        if program.needs <= backend.provides and backend.refuses(program) is None:
            ranked.append(backend)
    return sorted(ranked, key=lambda b: b.reference_rank or 0)


class Session:
    """The problems and references of one run."""

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self.problems = Problems()
        self.references = References(experiment, self.problems)

    def problem(self, cell: Cell) -> Problem:
        """The cell's program on its backend."""
        return self.problems.of(cell.backend, cell)
