"""Turns cells into rows: what has finished is stored before it is shown and before anything depends on it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any, Protocol

from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.machine import kind_of_machine
from bench.model import guard
from bench.run import launchers
from bench.run.launchers import Launcher
from bench.run.plan import Planned
from bench.run.pool import Answer
from bench.run.reference_backends import reference_key
from bench.run.session import Session
from bench.run.store import Store
from bench.run.tasks import FAILED, Task, blank, explained, grouped, outcome, row_of

__all__ = ["Stopped", "Watcher", "blank", "outcome", "run"]


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
        self._kind = ""

    def all(self, planned: list[Planned]) -> None:
        """Store a row for every cell that has none."""
        todo = [item for item in planned if not item.stored]
        self._kind = next((item.machine for item in planned if item.machine), "")
        refused = [(i.cell, dict(zip(("status", "reason"), i.refusal, strict=True))) for i in todo if i.refusal]
        if refused:
            self._finish([(cell, result | {"machine": kind_of_machine()}) for cell, result in refused])
        waiting = [item.cell for item in todo if item.refusal is None]
        # backends are asked whether they can compute references
        with guard.capture_output("a plugin"), guard.protect_process():
            references = self._missing_references(waiting)
        if not self._experiment.timing:
            with launchers.of(self._experiment) as pool:
                self._measure(self._referenced(waiting, references, pool), pool)
            return
        if references:
            with launchers.of(self._experiment) as pool:
                waiting = self._referenced(waiting, references, pool)
        # timed cells run one at a time and may use all cores
        with launchers.of(self._experiment, timed=True, kind=self._kind) as pool:
            self._measure(waiting, pool)

    def _missing_references(self, waiting: list[Cell]) -> list[Cell]:
        """Return one cell for each reference to compute; closed forms are left to the cells themselves."""
        if self._experiment.budget is None:
            return []
        references = Session(self._experiment).references
        # reversed twice, to keep the first cell of each key and the planned order
        first = {reference_key(cell): cell for cell in reversed(waiting)}
        return [cell for cell in reversed(first.values()) if not references.stored(cell) and not _has_closed_form(cell)]

    def _referenced(self, waiting: list[Cell], references: list[Cell], pool: Launcher) -> list[Cell]:
        """Compute references and return the cells left to measure; cells of a failed reference are finished."""
        tasks = [Task(cell, reference=True) for cell in references]
        failed: dict[str, dict[str, Any]] = {}
        for answer in itertools.chain.from_iterable(self._answers(tasks, pool)):
            if answer.result["status"] != "ok":
                failed[reference_key(answer.item.cell)] = explained(answer, "its reference gradient: ")
        if failed:
            self._finish([(cell, failed[reference_key(cell)]) for cell in waiting if reference_key(cell) in failed])
        return [cell for cell in waiting if reference_key(cell) not in failed] if failed else waiting

    def _measure(self, waiting: list[Cell], pool: Launcher) -> None:
        for answers in self._answers([Task(cell) for cell in waiting], pool):
            done = [(answer, (answer.item.cell, explained(answer))) for answer in answers]
            self._finish([result for answer, result in done if not answer.stored])
            self._finish([result for answer, result in done if answer.stored], stored=True)

    def _answers(self, tasks: list[Task], pool: Launcher) -> Iterator[list[Answer]]:
        with guard.capture_output("a plugin"), guard.protect_process():
            groups = grouped(tasks)
        for answers in pool.run(groups):
            guard.raise_pending_interrupt()
            if answers:
                yield answers
            self._tell("; ".join(str(item) for item in pool.current))

    def _finish(self, results: list[tuple[Cell, dict[str, Any]]], stored: bool = False) -> None:
        """Store results where their machine has not done so, then show them."""
        rows = [row_of(self._experiment, cell, result) for cell, result in results]
        if rows and not stored:
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


def _has_closed_form(cell: Cell) -> bool:
    try:
        return cell.program().closed_form_gradient() is not None
    except KeyboardInterrupt:
        raise
    except BaseException:  # its own worker reports the error
        return True
