"""Plan, then cells to rows: what has finished is stored before it is shown and before anything depends on it."""

from __future__ import annotations

import itertools
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Protocol

from bench import studies
from bench.contracts import Backend, Plugin
from bench.errors import StorageError, failure
from bench.grid import Cell, Experiment, cells, fingerprint
from bench.registry import remember
from bench.session import Session
from bench.store import Store
from bench.studies import Study
from bench.workers import Answer, Limits, Pool

FAILED = ("error", "crashed", "timeout")
"""Statuses of cells that something went wrong with."""


@dataclass(frozen=True)
class Planned:
    """A cell, and whether it is stored already, refused or to be run."""

    cell: Cell
    stored: bool
    refusal: tuple[str, str] | None
    aged: str = ""
    """Library versions that made the stored row, where they are not those at hand."""

    @property
    def runs(self) -> bool:
        """Whether the cell has to be simulated."""
        return not self.stored and self.refusal is None


def plan(experiment: Experiment, store: Store) -> list[Planned]:
    """Every cell of the experiment in order; raises :class:`UserError` for a bad one."""
    rows = store.load()
    stored = dict(zip(rows["key"], zip(rows["status"], rows["versions"], strict=True), strict=True))
    return [_planned(experiment, cell, stored) for cell in cells(settled(experiment))]


def _planned(experiment: Experiment, cell: Cell, stored: dict[str, tuple[str, str]]) -> Planned:
    refusal = cell.refusal()
    if cell.key not in stored:
        return Planned(cell, False, refusal)
    status, made_by = stored[cell.key]
    rules = experiment.execution
    aged = made_by if rules.versions != "ignore" and status == "ok" and made_by != versions(cell.backend) else ""
    again = status in rules.retry or (bool(aged) and rules.versions == "rerun")
    installed = status == "unavailable" and refusal is None
    return Planned(cell, not (again or installed), refusal, aged)


def settled(experiment: Experiment) -> Experiment:
    """The experiment with what its study decides: whether cells are timed, and whether they are held to a reference."""
    columns = studies.find(experiment.study).COLUMNS
    timing = bool(columns.measured) if experiment.timing is None else experiment.timing
    return replace(experiment, timing=timing, referenced=columns.referenced)


# ------------------------------------------------------------------------------------------------ in a worker


@dataclass(frozen=True)
class Task:
    """A cell to measure, or to compute the reference of."""

    cell: Cell
    reference: bool = False

    def __str__(self) -> str:
        parts = [self.cell.scene, self.cell.contact, self.backend, None if self.reference else self.cell.estimator]
        return " ".join(["reference of" if self.reference else "", *(p.name for p in parts if p is not None)]).strip()

    @property
    def backend(self) -> Backend:
        """The backend that the work is done on."""
        return self.cell.reference_backend if self.reference else self.cell.backend


class Measure:
    """Handles tasks of one experiment, in a worker or here."""

    def __init__(self, experiment: Experiment) -> None:
        self._session = Session(experiment)
        self._study = studies.find(experiment.study)

    def prepare(self, item: Task) -> None:
        """Have the backend import its libraries, as it does when it is given a program."""
        with suppress(Exception):  # what fails now fails again as the cell's own
            self._session.problems.of(item.backend, item.cell)

    def __call__(self, item: Task) -> dict[str, Any]:
        """The results of the cell, or the status and reason of its failure."""
        if not item.reference:
            return outcome(item.cell, self._session, self._study)
        try:
            self._session.references.of(item.cell)
        except StorageError:
            raise
        except Exception as error:
            return failure(error)
        return {"status": "ok"}


def outcome(cell: Cell, session: Session, study: Study) -> dict[str, Any]:
    """The results of a cell, or the status and reason of its failure; never raises for what a plugin does."""
    try:
        result = study.measure(cell, session)
    except StorageError:
        raise
    except Exception as error:
        return dict(failure(error))
    if cell.timing:
        return result
    empty = study.COLUMNS.blank()
    return result | {name: empty[name] for name in study.COLUMNS.measured}


# ------------------------------------------------------------------------------------------------ a run


class Watcher(Protocol):
    """What is told of a run's progress."""

    def __call__(self, cell: Cell, row: dict[str, Any]) -> None:
        """One cell is finished and stored."""


def run(
    experiment: Experiment, planned: list[Planned], store: Store, watch: Watcher, tell: Callable[[str], Any] = str
) -> None:
    """Run the missing cells and store their rows; ``tell`` hears now and then what is being worked on.

    Raises :class:`Stopped` after a failed cell where the experiment says so.
    """
    store.prepare()
    _Run(settled(experiment), store, watch, tell).all(planned)


class _Run:
    """One run: references first, on all workers; then the cells, timed ones alone."""

    def __init__(self, experiment: Experiment, store: Store, watch: Watcher, tell: Callable[[str], Any]) -> None:
        self._experiment, self._store, self._watch, self._tell = experiment, store, watch, tell
        self._study = studies.find(experiment.study)
        rules = experiment.execution
        self._workers = (os.cpu_count() or 1) if rules.workers is None else rules.workers
        self._limits = Limits(rules.timeout, rules.memory)

    def all(self, planned: list[Planned]) -> None:
        """Rows for every cell that has none."""
        todo = [item for item in planned if not item.stored]
        refused = [(i.cell, dict(zip(("status", "reason"), i.refusal, strict=True))) for i in todo if i.refusal]
        if refused:
            self._finish(refused)
        waiting = [item.cell for item in todo if item.refusal is None]
        references = self._missing_references(waiting)
        if not self._experiment.timing:
            with self._pool(self._workers, single=True) as pool:
                self._measure(self._referenced(waiting, references, pool), pool)
            return
        if references:
            with self._pool(self._workers, single=True) as pool:
                waiting = self._referenced(waiting, references, pool)
        with self._pool(min(1, self._workers), single=False) as pool:
            self._measure(waiting, pool)

    def _pool(self, count: int, single: bool) -> Pool | Here:
        if not self._workers:
            return Here(Measure(self._experiment))
        lean = replace(self._experiment, choices={}, values={}, sweep={}, marks={})
        return Pool(count, Measure, lean, self._limits, single)

    def _missing_references(self, waiting: list[Cell]) -> list[Cell]:
        """One cell for each reference that has to be computed; closed forms are left to the cells themselves."""
        if not self._experiment.referenced:
            return []
        known = Session(self._experiment).references
        first = {cell.reference_key: cell for cell in reversed(waiting)}
        return [cell for cell in reversed(first.values()) if not known.stored(cell) and not _has_closed_form(cell)]

    def _referenced(self, waiting: list[Cell], references: list[Cell], pool: Pool | Here) -> list[Cell]:
        """The cells left to measure once the references are there; those of a reference that failed are finished."""
        tasks = [Task(cell, reference=True) for cell in references]
        failed: dict[str, dict[str, Any]] = {}
        for answer in itertools.chain.from_iterable(self._answers(tasks, pool)):
            if answer.result["status"] != "ok":
                failed[answer.item.cell.reference_key] = _explained(answer, "its reference gradient: ")
        if failed:
            self._finish([(cell, failed[cell.reference_key]) for cell in waiting if cell.reference_key in failed])
        return [cell for cell in waiting if cell.reference_key not in failed] if failed else waiting

    def _measure(self, waiting: list[Cell], pool: Pool | Here) -> None:
        for answers in self._answers([Task(cell) for cell in waiting], pool):
            self._finish([(answer.item.cell, _explained(answer)) for answer in answers])

    def _answers(self, tasks: list[Task], pool: Pool | Here) -> Iterator[list[Answer]]:
        for answers in pool.run(_grouped(tasks)):
            if answers:
                yield answers
            self._tell("; ".join(str(item) for item in pool.current))

    def _finish(self, results: list[tuple[Cell, dict[str, Any]]]) -> None:
        """Store results, then show them."""
        rows = [blank(self._experiment, cell, self._study) | result for cell, result in results]
        self._store.append(*rows)
        for (cell, _), row in zip(results, rows, strict=True):
            self._watch(cell, row)
        if self._experiment.execution.stop:
            for row in rows:
                if row["status"] in FAILED:
                    raise Stopped(row)


class Stopped(Exception):
    """A cell has failed in a run that was to end then."""

    def __init__(self, row: dict[str, Any]) -> None:
        super().__init__(f"{row['scene']} {row['backend']} {row['estimator']}: {row['status']}, {row['reason']}")


class Here:
    """Stands for a pool, and handles items in this process: no limits, but a debugger can follow."""

    def __init__(self, handle: Measure) -> None:
        self._handle = handle
        self.current: list[Task] = []

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def run(self, groups: Iterable[Iterable[Task]]) -> Iterator[list[Answer]]:
        """One answer after the other."""
        for task in itertools.chain.from_iterable(groups):
            self.current = [task]
            yield []
            started = time.perf_counter()
            yield [Answer(task, self._handle(task), time.perf_counter() - started)]


def _grouped(tasks: list[Task]) -> list[list[Task]]:
    """Tasks that share a compilation together, in the order in which the first of each group was planned."""
    groups: dict[Any, list[Task]] = defaultdict(list)
    for task in tasks:
        groups[fingerprint(task.backend), repr(task.cell.program().structure)].append(task)
    return list(groups.values())


def _has_closed_form(cell: Cell) -> bool:
    try:
        return cell.scene.closed_form_gradient(cell.contact, cell.integrator) is not None
    except Exception:  # its own worker will say so
        return True


def _explained(answer: Answer, about: str = "") -> dict[str, Any]:
    """The result, with what was printed in the reason of a failed one."""
    result = answer.result | {"wall_s": answer.seconds}
    if result["status"] in FAILED:
        output = f"; last output: {answer.output}" if answer.output else ""
        result["reason"] = f"{about}{result['reason']}{output}"
    return result


def blank(experiment: Experiment, cell: Cell, study: Study) -> dict[str, Any]:
    """A row with its identity filled in and every result missing."""
    row: dict[str, Any] = study.COLUMNS.blank()
    row |= cell.columns()
    row["experiment"] = experiment.name
    row["versions"] = versions(cell.backend)
    return row


def versions(backend: Backend) -> str:
    """Versions of the libraries that a backend's numbers rest on."""
    return _versions(type(backend))


@remember
def _versions(backend: type[Plugin]) -> str:
    names = dict.fromkeys(["numpy", *(r.partition("=")[2] or r.partition("=")[0] for r in backend.requires)])
    return ";".join(f"{name}={_version(name)}" for name in names)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "?"
