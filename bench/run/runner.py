"""Runs cells and stores their rows. A row is stored before it is reported."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.model import Estimator, guard
from bench.run.launchers import launcher_of
from bench.run.launchers.launcher import Launcher
from bench.run.plan import Planned
from bench.run.pool import Answer
from bench.run.record import kind_of_machine
from bench.run.session import Session
from bench.run.store import Store
from bench.run.tasks import FAILED, Task, group_by_program, result_of, row_of

Result = tuple[Cell, dict[str, Any]]
"""A cell and the results of its row."""


@dataclass
class Runner:
    """Runs the missing cells of an experiment: references on all workers, then cells, one at a time if they are timed."""

    experiment: Experiment
    store: Store
    on_finished: Callable[[Cell, dict[str, Any]], None]
    """Called with every cell and its stored row."""
    on_progress: Callable[[str], Any] = str
    """Called repeatedly with the names of the tasks being worked on."""

    def run(self, planned: Sequence[Planned]) -> None:
        """Store a row for every cell that has none.

        Raises :class:`Stopped` after a failed cell if the experiment has ``on_error=stop``.
        """
        self.store.prepare()
        due = [item for item in planned if not item.stored]
        kind = next((item.machine for item in planned if item.machine), "")
        refused = [(i.cell, dict(zip(("status", "reason"), i.refusal, strict=True))) for i in due if i.refusal]
        if refused:
            self._finish([(cell, result | {"machine": kind_of_machine()}) for cell, result in refused])
        cells = [item.cell for item in due if item.refusal is None]
        with (
            guard.capture_output("a plugin"),
            guard.protect_process(),
        ):  # this calls backends, to find out which can compute references
            references = self._missing_references(cells)
        if not self.experiment.timing:
            with launcher_of(self.experiment) as launcher:
                self._measure(self._compute_references(cells, references, launcher), launcher)
            return
        if references:
            with launcher_of(self.experiment) as launcher:
                cells = self._compute_references(cells, references, launcher)
        with launcher_of(self.experiment, timed=True, kind=kind) as launcher:
            self._measure(cells, launcher)

    def _missing_references(self, cells: list[Cell]) -> list[Cell]:
        """Return one cell for each reference to compute; closed forms are computed when their cells are measured."""
        if self.experiment.budget is None:
            return []
        references = Session(self.experiment).references
        # reversed twice, so that the first cell of each key remains, in the planned order
        first = {cell.reference_key: cell for cell in reversed(cells)}
        return [cell for cell in reversed(first.values()) if not references.stored(cell) and not _has_closed_form(cell)]

    def _compute_references(self, cells: list[Cell], references: list[Cell], launcher: Launcher) -> list[Cell]:
        """Compute references and return the cells to measure; cells whose reference failed are stored with its status."""
        tasks = [Task(_for_reference(cell), reference=True) for cell in references]
        failed: dict[str, dict[str, Any]] = {}
        for answer in itertools.chain.from_iterable(self._answers(tasks, launcher)):
            if answer.result["status"] != "ok":
                failed[answer.item.cell.reference_key] = result_of(answer, "its reference gradient: ")
        if not failed:
            return cells
        self._finish([(cell, failed[cell.reference_key]) for cell in cells if cell.reference_key in failed])
        return [cell for cell in cells if cell.reference_key not in failed]

    def _measure(self, cells: list[Cell], launcher: Launcher) -> None:
        for answers in self._answers([Task(cell) for cell in cells], launcher):
            self._finish([(a.item.cell, result_of(a)) for a in answers])

    def _answers(self, tasks: list[Task], launcher: Launcher) -> Iterator[list[Answer]]:
        with guard.capture_output("a plugin"), guard.protect_process():
            groups = group_by_program(tasks)
        n_done = 0
        for answers in launcher.run(groups):
            guard.raise_pending_interrupt()
            n_done += len(answers)
            if answers:
                yield answers
            current = "; ".join(str(item) for item in launcher.current)
            if tasks[0].reference:  # references are no cells, so the counts of cells stand still meanwhile
                current += f" ({n_done} of {len(tasks)} references done)"
            self.on_progress(current)

    def _finish(self, results: list[Result]) -> None:
        """Store rows and report them; raises :class:`Stopped` if due."""
        rows = [row_of(self.experiment, cell, result) for cell, result in results]
        if rows:
            self.store.append(*rows)
        for (cell, _), row in zip(results, rows, strict=True):
            self.on_finished(cell, row)
        if self.experiment.execution.stop:
            for row in rows:
                if row["status"] in FAILED:
                    raise _stopped_by(row)


class Stopped(Exception):
    """Raised when a run ends before its last cell: a cell failed in a run with ``on_error=stop``, or rows are missing."""


def _stopped_by(row: dict[str, Any]) -> Stopped:
    names = " ".join(str(row[name]) for name in ("scene", "backend", "estimator") if row.get(name))
    return Stopped(f"after a failed cell ({names}: {row['status']}, {row['reason']})")


def _for_reference(cell: Cell) -> Cell:
    """Return the cell without its estimator, whose code the reference does not need, unless the estimator smooths J."""
    with suppress(Exception):  # the error is reported when the cell is measured
        if isinstance(cell.parts.get("estimator"), Estimator) and cell.smoothing() is None:
            return cell.with_part("estimator", None)
    return cell


def _has_closed_form(cell: Cell) -> bool:
    try:
        return cell.program().closed_form_gradient() is not None
    except KeyboardInterrupt:
        raise
    except BaseException:  # the error is reported when the cell is measured
        return True
