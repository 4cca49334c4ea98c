"""Runs one experiment from plan to files, for both the command line and the Python face."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

from bench.errors import StorageError, Unsupported, UserError
from bench.experiment.experiment import Experiment
from bench.experiment.study import study_of
from bench.measure import timing
from bench.run import progress, runner
from bench.run.files import tidy
from bench.run.plan import Planned, plan
from bench.run.store import Store


@dataclass(frozen=True, eq=False)
class Finished:
    """A run that ended by itself: its experiment, its stored rows, and how long it took."""

    experiment: Experiment
    store: Store
    planned: list[Planned]
    seconds: float

    @property
    def keys(self) -> list[str]:
        """The keys of its cells, in order."""
        return [item.cell.key for item in self.planned]


def store_of(experiment: Experiment) -> Store:
    """Return the store of an experiment's rows."""
    return Store(experiment.directory, experiment.columns, experiment.study.name)


def execute(experiment: Experiment, quiet: bool = True) -> Finished:
    """Run the missing cells of an experiment and fold their rows into ``rows.parquet``.

    Raises :class:`runner.Stopped` after a failed cell where the experiment says so, KeyboardInterrupt when interrupted
    (every cell finished by then is stored), and :class:`UserError` where the study refuses every cell.
    """
    started = time.time()
    # asked now, before the run itself loads the machine
    timing.load_at_start()
    store = store_of(experiment)
    planned = plan(experiment, store)
    refuse_nothing(experiment, planned)
    progress.print_versions(planned, experiment.execution.versions)
    progress.print_machines(planned, experiment.execution.launcher)
    store.prepare()
    for folder in (experiment.directory, experiment.directory / "pending", experiment.results_dir / "references"):
        tidy(folder)
    with progress.of(experiment.name, planned, quiet) as shown:
        try:
            runner.run(experiment, planned, store, shown.finished, shown.working)
        finally:
            _compact(store, planned)
    return Finished(experiment, store, planned, time.time() - started)


def refuse_nothing(experiment: Experiment, planned: Sequence[Planned]) -> None:
    """Raise :class:`UserError` where the study refuses every cell: then it is the experiment that is wrong, not a cell."""
    if any(item.refusal is None for item in planned):
        return
    study = study_of(experiment)
    try:
        reasons = dict.fromkeys(study.unsupported_reason(item.cell) for item in planned)
    except (Unsupported, UserError):
        return  # a cell without a program says so in its row, and no study is asked about it
    if reasons and None not in reasons:
        raise UserError(f"no cell can be run: {'; '.join(map(str, reasons))}")


def _compact(store: Store, planned: Sequence[Planned]) -> None:
    """Fold small files; a full disk must not hide why a run ended, and rows can be read from small files as well."""
    try:
        store.compact([item.cell.key for item in planned])
    except StorageError as error:
        print(f"bench: {error}; every finished cell is stored nevertheless", file=sys.stderr)
