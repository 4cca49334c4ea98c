"""Turns cells into rows: what has finished is stored before it is shown and before anything depends on it."""

from __future__ import annotations

import itertools
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

from bench.errors import StorageError, failure
from bench.model import Backend
from bench.sweep.cell import Cell
from bench.sweep.experiment import Experiment
from bench.sweep.keys import fingerprint
from bench.sweep.plan import Planned, versions
from bench.sweep.referees import reference_backends, reference_key
from bench.sweep.session import Session
from bench.sweep.store import Store
from bench.sweep.study import Study, study_of
from bench.sweep.workers import Answer, Limits, Pool

FAILED = ("error", "crashed", "timeout")
"""Statuses of cells in which something went wrong."""


# ------------------------------------------------------------------------------------------------ in a worker


@dataclass(frozen=True)
class Task:
    """A cell to measure, or to compute the reference of."""

    cell: Cell
    reference: bool = False

    def __str__(self) -> str:
        shown = {**self.cell.parts, "integrator": None, "backend": self.backend}
        parts = [part for axis, part in shown.items() if not (self.reference and axis == "estimator")]
        return " ".join(["reference of" if self.reference else "", *(p.name for p in parts if p is not None)]).strip()

    @property
    def backend(self) -> Backend:
        """The backend that does the work."""
        return next(reference_backends(self.cell)) if self.reference else self.cell.backend


class Measure:
    """Handles tasks of one experiment, in a worker or in this process."""

    def __init__(self, experiment: Experiment) -> None:
        self._session = Session(experiment)
        self._study = study_of(experiment)

    def prepare(self, item: Task) -> None:
        """Have the backend import its libraries, as it does when it gets a program."""
        try:
            self._session.problems.of(item.backend, item.cell)
        except KeyboardInterrupt:
            raise
        except BaseException:  # it will come again while the cell is measured, and is reported then
            return

    def __call__(self, item: Task) -> dict[str, Any]:
        """Return the results of the cell, or the status and reason of its failure."""
        if not item.reference:
            return outcome(item.cell, self._session, self._study)
        try:
            self._session.references.of(item.cell)
        except (StorageError, KeyboardInterrupt):
            raise
        except BaseException as error:
            return failure(error)
        return {"status": "ok"}


def outcome(cell: Cell, session: Session, study: Study) -> dict[str, Any]:
    """Return the results of a cell, or the status and reason of its failure; never raises for a plugin's error."""
    try:
        result = study.measure(cell, session)
    except (StorageError, KeyboardInterrupt):
        raise
    except BaseException as error:  # a plugin that exits must not end a run in this process
        return dict(failure(error))
    if cell.timing:
        return result
    empty = study.columns.blank()
    return result | {name: empty[name] for name in study.columns.measured}


# ------------------------------------------------------------------------------------------------ a run


class Watcher(Protocol):
    """Hears about a run's progress."""

    def __call__(self, cell: Cell, row: dict[str, Any]) -> None:
        """Take note of one cell that is finished and stored."""


def run(
    experiment: Experiment, planned: list[Planned], store: Store, watch: Watcher, tell: Callable[[str], Any] = str
) -> None:
    """Run the missing cells and store their rows; ``tell`` is called now and then with what is being worked on.

    Raises :class:`Stopped` after a failed cell where the experiment says so.
    """
    store.prepare()
    _Run(experiment, store, watch, tell).all(planned)


class _Run:
    """One run: references first, on all workers; then the cells, timed ones one at a time."""

    def __init__(self, experiment: Experiment, store: Store, watch: Watcher, tell: Callable[[str], Any]) -> None:
        self._experiment, self._store, self._watch, self._tell = experiment, store, watch, tell
        rules = experiment.execution
        self._workers = (os.cpu_count() or 1) if rules.workers is None else rules.workers
        self._limits = Limits(rules.timeout, rules.memory)

    def all(self, planned: list[Planned]) -> None:
        """Store a row for every cell that has none."""
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
        # timed cells run one at a time and may use all cores
        with self._pool(min(1, self._workers), single=False) as pool:
            self._measure(waiting, pool)

    def _pool(self, count: int, single: bool) -> Pool | InProcessPool:
        if not self._workers:
            return InProcessPool(Measure(self._experiment))
        # tasks bring their own plugins, so workers need no grid
        lean = replace(self._experiment, choices={}, values={}, sweep={}, marks={})
        return Pool(count, Measure, lean, self._limits, single, self._experiment.plugins)

    def _missing_references(self, waiting: list[Cell]) -> list[Cell]:
        """Return one cell for each reference to compute; closed forms are left to the cells themselves."""
        if self._experiment.budget is None:
            return []
        references = Session(self._experiment).references
        # reversed twice, to keep the first cell of each key and the planned order
        first = {reference_key(cell): cell for cell in reversed(waiting)}
        return [cell for cell in reversed(first.values()) if not references.stored(cell) and not _has_closed_form(cell)]

    def _referenced(self, waiting: list[Cell], references: list[Cell], pool: Pool | InProcessPool) -> list[Cell]:
        """Compute references and return the cells left to measure; cells of a failed reference are finished."""
        tasks = [Task(cell, reference=True) for cell in references]
        failed: dict[str, dict[str, Any]] = {}
        for answer in itertools.chain.from_iterable(self._answers(tasks, pool)):
            if answer.result["status"] != "ok":
                failed[reference_key(answer.item.cell)] = _explained(answer, "its reference gradient: ")
        if failed:
            self._finish([(cell, failed[reference_key(cell)]) for cell in waiting if reference_key(cell) in failed])
        return [cell for cell in waiting if reference_key(cell) not in failed] if failed else waiting

    def _measure(self, waiting: list[Cell], pool: Pool | InProcessPool) -> None:
        for answers in self._answers([Task(cell) for cell in waiting], pool):
            self._finish([(answer.item.cell, _explained(answer)) for answer in answers])

    def _answers(self, tasks: list[Task], pool: Pool | InProcessPool) -> Iterator[list[Answer]]:
        for answers in pool.run(_grouped(tasks)):
            if answers:
                yield answers
            self._tell("; ".join(str(item) for item in pool.current))

    def _finish(self, results: list[tuple[Cell, dict[str, Any]]]) -> None:
        """Store results, then show them."""
        rows = [blank(self._experiment, cell) | result for cell, result in results]
        self._store.append(*rows)
        for (cell, _), row in zip(results, rows, strict=True):
            self._watch(cell, row)
        if self._experiment.execution.stop:
            for row in rows:
                if row["status"] in FAILED:
                    raise Stopped(row)


class Stopped(Exception):
    """Raised when a cell failed in a run that was to stop then."""

    def __init__(self, row: dict[str, Any]) -> None:
        what = " ".join(str(row[name]) for name in ("scene", "backend", "estimator") if row.get(name))
        super().__init__(f"{what}: {row['status']}, {row['reason']}")


class InProcessPool:
    """Runs tasks in this process, without limits on time and memory, for debugging."""

    def __init__(self, handle: Measure) -> None:
        self._handle = handle
        self.current: list[Task] = []

    def __enter__(self) -> InProcessPool:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def run(self, groups: Iterable[Iterable[Task]]) -> Iterator[list[Answer]]:
        """Yield one answer after the other."""
        for task in itertools.chain.from_iterable(groups):
            self.current = [task]
            yield []
            started = time.perf_counter()
            yield [Answer(task, self._handle(task), time.perf_counter() - started)]


def _grouped(tasks: list[Task]) -> list[list[Task]]:
    """Group tasks that share a compilation, in the order in which the first of each group was planned."""
    groups: dict[Any, list[Task]] = defaultdict(list)
    for task in tasks:
        groups[fingerprint(task.backend), repr(task.cell.program().structure)].append(task)
    return list(groups.values())


def _has_closed_form(cell: Cell) -> bool:
    try:
        return cell.program().closed_form_gradient() is not None
    except KeyboardInterrupt:
        raise
    except BaseException:  # its own worker reports the error
        return True


def _explained(answer: Answer, about: str = "") -> dict[str, Any]:
    """Return the result; the reason of a failed one includes the last output."""
    result = answer.result | {"wall_s": answer.seconds}
    if result["status"] in FAILED:
        output = f"; last output: {answer.output}" if answer.output else ""
        result["reason"] = f"{about}{result['reason']}{output}"
    return result


def blank(experiment: Experiment, cell: Cell) -> dict[str, Any]:
    """Return a row with its identity filled in and every result missing."""
    row: dict[str, Any] = experiment.columns.blank()
    row |= cell.columns()
    row["experiment"] = experiment.name
    row["versions"] = versions(cell.backend)
    return row
