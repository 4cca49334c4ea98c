"""Plan, then cells to rows: each row is stored before the next cell starts."""

from __future__ import annotations

import math
import traceback
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Protocol

import numpy as np

from bench import noise, reference, registry, statistics, timing
from bench.contracts import Backend, Problem, Unsupported
from bench.grid import Cell, Experiment, cells
from bench.reference import Reference
from bench.store import COLUMNS, EXTRA_COLUMNS, TEXT, Store

TIMED_CALLS = 5
"""Estimates timed one by one on backends that do not compile; the other repeats are evaluated together."""


@dataclass(frozen=True)
class Planned:
    """A cell, and whether it is stored already, refused or to be run."""

    cell: Cell
    stored: bool
    refusal: tuple[str, str] | None

    @property
    def runs(self) -> bool:
        """Whether the cell has to be simulated."""
        return not self.stored and self.refusal is None


def plan(experiment: Experiment, store: Store) -> list[Planned]:
    """Every cell of the experiment in order; raises :class:`UserError` for a bad one."""
    stored = set(store.load()["key"])
    return [Planned(cell, cell.key in stored, cell.refusal()) for cell in cells(experiment)]


class Watcher(Protocol):
    """What is told of a run's progress."""

    def __call__(self, cell: Cell, row: dict[str, Any]) -> None:
        """One cell is finished and stored."""


def run(experiment: Experiment, planned: list[Planned], store: Store, watch: Watcher) -> None:
    """Run the missing cells and store their rows."""
    store.prepare()
    problems = Problems()
    references = References(experiment, problems)
    for item in planned:
        if item.stored:
            continue
        row = blank(experiment, item.cell)
        if item.refusal is not None:
            row["status"], row["reason"] = item.refusal
        else:
            row |= outcome(item.cell, problems, references)
        store.append(row)
        watch(item.cell, row)


def blank(experiment: Experiment, cell: Cell) -> dict[str, Any]:
    """A row with its identity filled in and every result missing."""
    row: dict[str, Any] = {name: "" if name in TEXT else math.nan for name in (*COLUMNS, *EXTRA_COLUMNS)}
    row |= cell.columns()
    row["experiment"] = experiment.name
    row["versions"] = versions(cell.backend)
    return row


def outcome(cell: Cell, problems: Problems, references: References) -> dict[str, Any]:
    """The results of a cell, or the status and reason of its failure; never raises for what a plugin does."""
    try:
        return measure(cell, problems, references)
    except Unsupported as error:
        return {"status": "unsupported", "reason": str(error)}
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{where.filename.rpartition('/')[2]}:{where.lineno}"
        return {"status": "error", "reason": f"{type(error).__name__}: {error} ({place})"}


def measure(cell: Cell, problems: Problems, references: References) -> dict[str, Any]:
    """Estimates of one cell held against the reference."""
    program = cell.program()
    theta = cell.scene.theta0()
    truth = references.of(cell)
    problem = problems.of(cell.backend, cell)
    w = noise.shared(cell.seed, cell.scene.name, cell.repeats, cell.samples, program.n_noise)

    def estimate(block: np.ndarray) -> np.ndarray:
        result = np.asarray(cell.estimator.estimate(problem, theta, block), dtype=np.float64)
        if result.shape != (block.shape[0], problem.dim):
            raise ValueError(
                f"{cell.estimator.name} returned shape {result.shape}, not {(block.shape[0], problem.dim)}"
            )
        return result

    timing.reset_peak_memory()
    calls = cell.repeats if cell.backend.compiles else min(TIMED_CALLS, cell.repeats)
    problem.reset_usage()
    parts, clock = timing.timed(lambda r: estimate(w[r : r + 1]), calls)
    usage = replace(problem.usage)
    if calls < cell.repeats:
        parts.append(estimate(w[calls:]))
    estimates = np.concatenate(parts)

    result: dict[str, Any] = {
        "status": "ok",
        "reference_method": truth.method,
        "model_error": truth.model_error,
        "time_s": clock.median_s,
        "time_iqr_s": clock.iqr_s,
        "compile_s": usage.compile_s,
        "rollouts": usage.rollouts / (calls + 1),
        "gradients": usage.gradients / (calls + 1),
        "peak_memory_mb": timing.peak_memory_mb(),
        "device": "cpu",
    }
    if not np.isfinite(truth.batches).all():
        return result | {"status": "nonfinite", "reason": "the reference gradient is not finite"}
    summary = asdict(statistics.summarise(estimates, truth_of(truth), cell.samples))
    result |= {"reason": summary.pop("note"), **summary}
    bad = ~np.isfinite(estimates).all(axis=1)
    if bad.any():
        result["status"] = "nonfinite"
        result["reason"] += f", the first in repeat {int(np.argmax(bad))} of seed {cell.seed}"
    return result


def truth_of(found: Reference) -> statistics.Truth:
    """The reference as the statistics take it."""
    if found.batches.shape[0] > 1:
        return statistics.Truth.from_batches(found.batches)
    return statistics.Truth.exact(found.gradient, found.error)


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


def versions(backend: Backend) -> str:
    """Versions of the libraries that a backend's numbers rest on."""
    names = dict.fromkeys(["numpy", *(r.partition("=")[2] or r.partition("=")[0] for r in backend.requires)])
    return ";".join(f"{name}={_version(name)}" for name in names)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "?"
