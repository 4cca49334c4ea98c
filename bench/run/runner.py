"""Runs cells and stores their rows. A row is stored before it is reported."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
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
REPEAT_S = 1.0
"""Seconds between reports of the tasks being worked on, while one task keeps this process busy (``workers=0``)."""


def run(
    experiment: Experiment,
    planned: list[Planned],
    store: Store,
    on_finished: Callable[[Cell, dict[str, Any]], None],
    on_progress: Callable[[str], Any] = str,
) -> None:
    """Run the missing cells and store their rows.

    ``on_finished`` is called with every cell and its stored row, and ``on_progress`` repeatedly with the names of the
    tasks being worked on. Raises :class:`Stopped` after a failed cell if the experiment has ``on_error=stop``.
    """
    store.prepare()
    _Run(experiment, store, on_finished, on_progress).run_all(planned)


class _Run:
    """One run: computes references on all workers, then measures cells, one at a time if they are timed."""

    def __init__(
        self,
        experiment: Experiment,
        store: Store,
        on_finished: Callable[[Cell, dict[str, Any]], None],
        on_progress: Callable[[str], Any],
    ) -> None:
        self._experiment, self._store = experiment, store
        self._on_finished, self._on_progress = on_finished, on_progress
        self._current = ""
        """The tasks that a launcher is working on; empty between two launches."""

    @contextmanager
    def _repeated_progress(self) -> Iterator[None]:
        """Report progress from a thread too, since a task that runs in this process stops all reports until its end."""
        is_over = threading.Event()

        def repeat() -> None:
            while not is_over.wait(REPEAT_S):
                with suppress(Exception):  # a plugin may have closed or replaced the stream
                    if current := self._current:
                        self._on_progress(current)

        thread = threading.Thread(target=repeat, name="bench-progress", daemon=True)
        thread.start()
        try:
            yield
        finally:
            is_over.set()
            thread.join()

    def run_all(self, planned: list[Planned]) -> None:
        """Store a row for every cell that has none."""
        in_process = self._experiment.execution.workers == 0
        with self._repeated_progress() if in_process else nullcontext():
            self._run_all(planned)

    def _run_all(self, planned: list[Planned]) -> None:
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
        if not self._experiment.timing:
            with launcher_of(self._experiment) as launcher:
                self._measure(self._compute_references(cells, references, launcher), launcher)
            return
        if references:
            with launcher_of(self._experiment) as launcher:
                cells = self._compute_references(cells, references, launcher)
        with launcher_of(self._experiment, timed=True, kind=kind) as launcher:
            self._measure(cells, launcher)

    def _missing_references(self, cells: list[Cell]) -> list[Cell]:
        """Return one cell for each reference to compute; closed forms are computed when their cells are measured."""
        if self._experiment.budget is None:
            return []
        references = Session(self._experiment).references
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
        try:
            for answers in launcher.run(groups):
                guard.raise_pending_interrupt()
                n_done += len(answers)
                if answers:
                    yield answers
                current = "; ".join(str(item) for item in launcher.current)
                if tasks[0].reference:  # references are no cells, so the counts of cells stand still meanwhile
                    current += f" ({n_done} of {len(tasks)} references done)"
                self._current = current
                self._on_progress(current)
        finally:
            self._current = ""

    def _finish(self, results: list[Result]) -> None:
        """Store rows and report them; raises :class:`Stopped` if due."""
        rows = [row_of(self._experiment, cell, result) for cell, result in results]
        if rows:
            self._store.append(*rows)
        for (cell, _), row in zip(results, rows, strict=True):
            self._on_finished(cell, row)
        if self._experiment.execution.stop:
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
