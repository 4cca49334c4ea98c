"""Tasks: a cell to measure or its reference to compute, how they are grouped, and the rows they end in."""

from __future__ import annotations

import itertools
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from bench.errors import StorageError, failure, printable
from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.keys import fingerprint
from bench.experiment.machine import kind_of_machine
from bench.experiment.study import Study, study_of
from bench.model import Backend, guard
from bench.run.plan import versions
from bench.run.pool import Answer
from bench.run.reference_backends import reference_backends
from bench.run.session import Session

LONGEST = 2000
"""Letters of a reason that are kept."""
FAILED = ("error", "crashed", "timeout")
"""Statuses of cells in which something went wrong."""

TOGETHER_S = 0.05
"""Seconds of work in this process that are stored together."""


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
        with guard.protect_process():
            try:
                self._session.problems.of(item.backend, item.cell)
            except KeyboardInterrupt:
                raise
            except BaseException:  # it will come again while the cell is measured, and is reported then
                return

    def __call__(self, item: Task) -> dict[str, Any]:
        """Return the results of the cell, or the status and reason of its failure."""
        with guard.protect_process():
            return self._result(item)

    def _result(self, item: Task) -> dict[str, Any]:
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
        """Yield answers, those of quick tasks together: to outlast a power cut takes longer than a small cell."""
        done: list[Answer] = []
        since = time.perf_counter()
        for task in itertools.chain.from_iterable(groups):
            self.current = [task]
            yield []
            started = time.perf_counter()
            try:
                done.append(Answer(task, self._handle(task), time.perf_counter() - started))
            except BaseException:
                yield done  # they are stored before the end
                raise
            if time.perf_counter() - since > TOGETHER_S or done[-1].result["status"] in FAILED:
                yield done
                done, since = [], time.perf_counter()
        if done:
            yield done


def grouped(tasks: list[Task]) -> list[list[Task]]:
    """Group tasks that share a compilation, in the order in which the first of each group was planned."""
    groups: dict[Any, list[Task]] = defaultdict(list)
    for task in tasks:
        groups[fingerprint(task.backend), repr(task.cell.program().structure)].append(task)
    return list(groups.values())


def explained(answer: Answer, about: str = "") -> dict[str, Any]:
    """Return the result; the reason of a failed one includes the last output."""
    result = answer.result | {"wall_s": answer.seconds, "machine": answer.machine or kind_of_machine()}
    if result["status"] in FAILED:
        output = f"; last output: {answer.output}" if answer.output else ""
        result["reason"] = f"{about}{result['reason']}{output}"
    return result


def row_of(experiment: Experiment, cell: Cell, result: dict[str, Any]) -> dict[str, Any]:
    """Return the row of a result; a reason is one line of a length that can be read, whatever a plugin says."""
    row = blank(experiment, cell) | result
    reason = printable(row["reason"])
    return row | {"reason": reason if len(reason) <= LONGEST else f"{reason[:LONGEST]}... ({len(reason)} letters)"}


def blank(experiment: Experiment, cell: Cell) -> dict[str, Any]:
    """Return a row with its identity filled in and every result missing."""
    row: dict[str, Any] = experiment.columns.blank()
    row |= cell.columns()
    row["experiment"] = experiment.name
    row["versions"] = versions(cell.backend)
    return row
