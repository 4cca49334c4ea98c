"""What the cells of one run share: compiled problems and reference gradients."""

from __future__ import annotations

from collections.abc import Iterator

from bench import reference, registry
from bench.contracts import Backend, Problem
from bench.grid import Cell, Experiment
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
                found = reference.certify(problem, backend.provides, *self._budget)
                reference.save(found, path)
            self._known[key] = found
        return self._known[key]


def reference_backends(cell: Cell) -> Iterator[Backend]:
    """Backends able to run the cell's program for a reference, best first, the cell's own last."""
    program = cell.program()
    ranked = []
    for entry in registry.entries()["backends"].values():
        plugin = entry.plugin
        if plugin is None or not entry.available or not issubclass(plugin, Backend) or plugin.reference_rank is None:
            continue
        backend = plugin()
        if (not program.needs_root or "root" in backend.provides) and backend.refuses(program) is None:
            ranked.append(backend)
    yield from sorted(ranked, key=lambda b: b.reference_rank or 0)
    yield cell.backend


class Session:
    """The problems and references of one run."""

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self.problems = Problems()
        self.references = References(experiment, self.problems)

    def problem(self, cell: Cell) -> Problem:
        """The cell's program on its backend."""
        return self.problems.of(cell.backend, cell)
