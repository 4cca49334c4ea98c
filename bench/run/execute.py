"""Runs one experiment from its plan to its stored rows, for both the command line and Python."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from bench.errors import StorageError, Unsupported, UserError
from bench.experiment.defaults import completed_rows
from bench.experiment.experiment import Experiment
from bench.experiment.study import study_of
from bench.measure import timing
from bench.run import progress, runner
from bench.run.files import remove_stale
from bench.run.ladder import climb
from bench.run.plan import Planned, plan
from bench.run.store import Store, sort_rows

if TYPE_CHECKING:
    import pandas as pd

MAX_REPAIRS = 2
"""Number of times that cells whose rows are gone at the end of a run are run again."""


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

    Cells whose rows are gone at the end, for example since the results folder was renamed or removed, are run again.
    Raises :class:`runner.Stopped` after a failed cell in an experiment with ``on_error=stop`` and if rows are missing
    even so, KeyboardInterrupt if interrupted (every cell finished by then is stored), and :class:`UserError` if the study
    supports no cell.
    """
    started = time.time()
    # measured before the run itself loads the machine
    timing.load_at_start()
    store = store_of(experiment)
    planned = plan(experiment, store)
    _refuse_without_supported_cells(experiment, planned)
    progress.print_versions(planned, experiment.execution.versions)
    progress.print_machines(planned, experiment.execution.launcher)
    store.prepare()
    for folder in (experiment.directory, experiment.directory / "pending", experiment.results_dir / "references"):
        remove_stale(folder)
    _run(experiment, planned, store, quiet)
    for is_last in (*[False] * MAX_REPAIRS, True):
        stored = set(store.load()["key"])
        rest = [replace(item, stored=item.cell.key in stored) for item in planned]
        if all(item.stored for item in rest):
            break
        missing = sum(not item.stored for item in rest)
        if is_last:
            raise runner.Stopped(f"since {missing} cells were run and have no row")
        print(
            f"bench: {missing} of {len(planned)} cells were run and have no row in '{store.directory}': was it renamed or "
            "removed? They are run again",
            file=sys.stderr,
        )
        _run(experiment, rest, store, quiet)
    progress.print_others(experiment, planned, stored)
    return Finished(experiment, store, planned, time.time() - started)


def _run(experiment: Experiment, planned: list[Planned], store: Store, quiet: bool) -> None:
    with progress.show_progress(experiment.name, planned, quiet) as shown:
        run = runner.Runner(experiment, store, shown.finished, shown.working).run
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
    study = study_of(experiment)
    try:
        reasons = dict.fromkeys(study.unsupported_reason(item.cell) for item in planned)
    except (Unsupported, UserError):
        return  # a cell without a program reports the reason in its row
    if reasons and None not in reasons:
        raise UserError(f"no cell can be run: {'; '.join(map(str, reasons))}")


def _compact(store: Store, planned: Sequence[Planned]) -> None:
    """Merge the small files. A failure is only printed: it loses no row, and an error would hide why the run ended."""
    try:
        store.compact([item.cell.key for item in planned])
    except StorageError as error:
        print(f"bench: {error}; no row is lost: those in 'pending' are read from there", file=sys.stderr)
