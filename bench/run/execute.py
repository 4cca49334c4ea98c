"""Runs one experiment from its plan to its stored rows, for both the command line and Python.

Cells run, their rows are stored, and then they are reported.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from bench.errors import StorageError, Unsupported, UserError
from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.experiment.keys import HASHED
from bench.experiment.parameters import completed_rows
from bench.host import guard, reads
from bench.measure import timing
from bench.measure.descent import DescentPath
from bench.model import Estimator
from bench.run import progress
from bench.run.files import remove_stale
from bench.run.ladder import climb
from bench.run.launchers import Launcher, launcher_of
from bench.run.plan import Planned, plan
from bench.run.pool import TaskResult
from bench.run.record import kind_of_machine
from bench.run.session import RunSession
from bench.run.shared import Shared
from bench.run.store import Store, sort_rows
from bench.run.tasks import FAILED, Task, group_by_program, result_of, row_of

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Finished:
    """A complete run: its experiment, its stored rows, and its duration."""

    experiment: Experiment
    store: Store
    planned: list[Planned]
    seconds: float

    @property
    def keys(self) -> list[str]:
        """Cell keys, in sweep order."""
        return [item.cell.key for item in self.planned]

    def rows(self) -> pd.DataFrame:
        """Return the stored rows of the cells, in sweep order, with parameters added since at their defaults."""
        rows = self.store.load()
        return completed_rows(sort_rows(rows[rows["key"].isin(self.keys)], self.keys))


def store_of(experiment: Experiment) -> Store:
    """Return the store of an experiment's rows."""
    return Store(experiment.directory, experiment.columns, experiment.study.name)


def execute(experiment: Experiment, quiet: bool = True) -> Finished:
    """Run the missing cells of an experiment and merge their rows into ``rows.parquet``.

    Raises :class:`Stopped` after a failed cell in an experiment with ``on_error=stop``, and where rows are gone at the end
    since the results folder was renamed or removed, KeyboardInterrupt if interrupted (every cell finished by then is stored),
    and :class:`UserError` if the study supports no cell.
    """
    started = time.time()
    # measured before the run itself loads the machine
    timing.load_at_start()
    store = store_of(experiment)
    planned = plan(experiment, store)
    _refuse_without_supported_cells(experiment, planned)
    progress.print_states(planned, experiment.execution.versions)
    store.prepare()
    for folder in (experiment.directory, experiment.directory / "pending", experiment.results_dir / "references"):
        remove_stale(folder)
    _run(experiment, planned, store, quiet)
    stored = set(store.load()["key"])
    if missing := len({item.cell.key for item in planned} - stored):
        raise Stopped(f"since {missing} cells were run and have no row: was '{store.directory}' renamed or removed?")
    progress.print_others(experiment, planned, stored)
    return Finished(experiment, store, planned, time.time() - started)


def _run(experiment: Experiment, planned: list[Planned], store: Store, quiet: bool) -> None:
    with progress.show_progress(experiment.name, planned, quiet) as shown:
        run = Runner(experiment, store, shown).run
        try:
            if experiment.execution.ladder:
                climb(experiment, planned, store, run, quiet)
            else:
                run(planned)
        finally:
            _compact(store, planned)


def _refuse_without_supported_cells(experiment: Experiment, planned: Sequence[Planned]) -> None:
    """Raise :class:`UserError` with the reasons if the study supports no cell of the experiment."""
    if any(item.refusal is None for item in planned):
        return
    try:
        reasons = dict.fromkeys(experiment.study.refusal(item.cell) for item in planned)
    except (Unsupported, UserError):
        return  # a cell without a program reports the reason in its row
    if reasons and None not in reasons:
        raise UserError(f"no cell can be run: {'; '.join(map(str, reasons))}")


def missing_references(experiment: Experiment, cells: Sequence[Cell]) -> list[Cell]:
    """Return one cell for each reference to compute; closed forms are computed when their cells are measured."""
    references = RunSession(experiment).references
    # reversed twice, so that the first cell of each key remains, in the planned order
    first = {cell.reference_key: cell for cell in reversed(cells) if cell.budget is not None}
    with guard.contained():  # this calls backends, to find out which can compute references
        return [cell for cell in reversed(first.values()) if not references.stored(cell) and not _has_closed_form(cell)]


def _compact(store: Store, planned: Sequence[Planned]) -> None:
    """Merge the small files. A failure is only printed: it loses no row, and an error would hide why the run ended."""
    try:
        store.compact([item.cell.key for item in planned])
    except StorageError as error:
        print(f"bench: {error}; no row is lost: those in 'pending' are read from there", file=sys.stderr)


@dataclass
class Runner:
    """Runs the missing cells of an experiment: references on all workers, then cells, one at a time if they are timed."""

    experiment: Experiment
    store: Store
    shown: progress.Progress
    read: dict[str, str] = field(default_factory=lambda: {reads.name_of(path): of for path, of in HASHED.items()})
    """Hashes of what code from outside has read in this run, by name."""

    def run(self, planned: Sequence[Planned]) -> None:
        """Store a row for every cell that has none.

        Raises :class:`Stopped` after a failed cell if the experiment has ``on_error=stop``.
        """
        due = [item for item in planned if not item.stored]
        refused = [(i.cell, dict(zip(("status", "reason"), i.refusal, strict=True))) for i in due if i.refusal]
        if refused:
            self._finish([(cell, result | {"machine": kind_of_machine()}) for cell, result in refused])
        cells = self._placed([item.cell for item in due if item.refusal is None])
        references = missing_references(self.experiment, cells)
        if not self.experiment.timing:
            with launcher_of(self.experiment) as launcher:
                self._measure(self._compute_references(cells, references, launcher), launcher)
            return
        if references:
            with launcher_of(self.experiment) as launcher:
                cells = self._compute_references(cells, references, launcher)
        with launcher_of(self.experiment, timed=True) as launcher:
            self._measure(cells, launcher)

    def _placed(self, cells: list[Cell]) -> list[Cell]:
        """Return cells with their places on descents; cells whose descent failed are stored with its status.

        A descent is computed once, stored, and shared by all cells of its scene.
        """
        starts = {cell.path.descent_key: cell.path for cell in cells if cell.path is not None}
        shared, known, failed = Shared(self.experiment), dict[str, DescentPath](), dict[str, dict[str, Any]]()
        for key in starts:
            with suppress(TypeError):  # none is stored, or it is no path
                known[key] = DescentPath(**(shared.load(f"descent_{key}") or {}))
        due = [start.with_part("backend", start.descent_backend) for key, start in starts.items() if key not in known]
        if due:
            with launcher_of(self.experiment) as launcher:
                answers = itertools.chain.from_iterable(
                    self._answers([Task(start, "descent") for start in due], launcher)
                )
                for answer in answers:
                    key = answer.item.cell.descent_key
                    if answer.result["status"] == "ok":
                        known[key] = DescentPath(**answer.result["descent"])
                        shared.save(f"descent_{key}", answer.result["descent"], answer.result.get("reads", ""))
                    else:
                        failed[key] = result_of(answer, "its descent: ")
        placed: list[Cell] = []
        for cell in cells:
            key = "" if cell.path is None else cell.path.descent_key
            if not key:
                placed.append(cell)
            elif key in failed:
                self._finish([(cell, failed[key])])
            elif known[key].reason:
                reason = {"status": "unsupported", "reason": f"no descent: {known[key].reason}"}
                self._finish([(cell, reason | {"machine": kind_of_machine()})])
            else:
                placed.append(replace(cell, point=known[key].at(cell.decision.descent)))
        return placed

    def _compute_references(self, cells: list[Cell], references: list[Cell], launcher: Launcher) -> list[Cell]:
        """Compute references and return the cells to measure; cells whose reference failed are stored with its status."""
        tasks = [Task(_for_reference(cell), "reference") for cell in references]
        failed = {
            answer.item.cell.reference_key: result_of(answer, "its reference gradient: ")
            for answer in itertools.chain.from_iterable(self._answers(tasks, launcher))
            if answer.result["status"] != "ok"
        }
        lost = {cell.key for cell in cells if cell.budget is not None and cell.reference_key in failed}
        self._finish([(cell, failed[cell.reference_key]) for cell in cells if cell.key in lost])
        return [cell for cell in cells if cell.key not in lost]

    def _measure(self, cells: list[Cell], launcher: Launcher) -> None:
        for answers in self._answers([Task(cell) for cell in cells], launcher):
            self._finish([(a.item.cell, result_of(a)) for a in answers])

    def _answers(self, tasks: list[Task], launcher: Launcher) -> Iterator[list[TaskResult]]:
        with guard.contained():
            groups = group_by_program(tasks)
        n_done = 0
        for answers in launcher.run(groups):
            guard.raise_pending_interrupt()
            n_done += len(answers)
            good = [*itertools.takewhile(lambda answer: not self._changed(answer), answers)]
            if good:
                yield good
            if len(good) < len(answers):
                raise Stopped(f"since {self._changed(answers[len(good)])} changed during the run")
            current = "; ".join(str(item) for item in launcher.current)
            if what := tasks[0].kind:
                # these are no cells, so the counts of cells stand still meanwhile
                current += f" ({n_done} of {len(tasks)} {what}s done)"
            self.shown.working(current)

    def _changed(self, answer: TaskResult) -> str:
        """Return what had another content when the cells were planned or an earlier one ran; empty if there is nothing."""
        read = json.loads(answer.result.get("reads") or "{}")
        return next((name for name, content in read.items() if self.read.setdefault(name, content) != content), "")

    def _finish(self, results: list[tuple[Cell, dict[str, Any]]]) -> None:
        """Store rows and report them; raises :class:`Stopped` if due."""
        rows = [row_of(self.experiment, cell, result) for cell, result in results]
        if rows:
            self.store.append(*rows)
        for row in rows:
            self.shown.finished(row)
        if self.experiment.execution.stop:
            for row in rows:
                if row["status"] in FAILED:
                    names = " ".join(str(row[name]) for name in ("scene", "backend", "estimator") if row.get(name))
                    raise Stopped(f"after a failed cell ({names}: {row['status']}, {row['reason']})")


class Stopped(Exception):
    """Raised when a run ends before its last cell: a cell failed in a run with ``on_error=stop``, or rows are missing."""


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
