"""Prints the plan of a run and its progress as plain text, since names may contain terminal codes or rich markup."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from bench.errors import printable
from bench.experiment.experiment import Experiment
from bench.experiment.grid import cells
from bench.run import record
from bench.run.plan import Planned, expected_seconds

if TYPE_CHECKING:
    import pandas as pd
    import rich.console
    import rich.progress

LINE_S = 10.0
"""Seconds between lines where the output is not a terminal; the first comes after half of them."""


class Progress:
    """Counts cells (done, failed, stored before), and shows counts and current tasks: in a bar or, with ``lines``, every 10 s."""

    def __init__(
        self, name: str, planned: Sequence[Planned], bars: rich.progress.Progress, lines: bool = False
    ) -> None:
        self._name, self._n_cells, self._bars, self._lines = name, len(planned), bars, lines
        self._n_done = sum(item.stored for item in planned)
        self._current = ""
        self._failed: Counter[str] = Counter()
        self._n_due = sum(item.runs for item in planned)  # stored and refused cells take no time
        self._task = bars.add_task(printable(name), total=self._n_due, counts=self._counts(), current="")
        self._printed_at = time.monotonic() - LINE_S / 2
        if lines and self._n_done:
            print(f"{name}: {self._n_done} of {self._n_cells} cells are stored", file=sys.stderr)

    def finished(self, row: dict[str, Any]) -> None:
        """Count one cell that is finished and stored."""
        self._n_done += 1
        # statuses that are not counted as failures
        if row["status"] not in ("ok", "unsupported", "waiting"):
            self._failed[row["status"]] += 1
        self._show()

    def working(self, tasks: str) -> None:
        """Set the names of the tasks being worked on."""
        self._current = printable(tasks)
        self._show()

    def _show(self) -> None:
        n_run = max(0, self._n_done - self._n_cells + self._n_due)
        self._bars.update(self._task, completed=n_run, counts=self._counts(), current=self._current)
        if self._lines and time.monotonic() - self._printed_at > LINE_S:
            self._printed_at = time.monotonic()
            seconds = self._bars.tasks[0].time_remaining
            left = f"about {timedelta(seconds=round(seconds))} left" if seconds else ""
            parts = [f"{self._counts()} cells", left, self._current and f"now {self._current}"]
            print(f"{self._name}: {'; '.join(filter(None, parts))}", file=sys.stderr)

    def _counts(self) -> str:
        """Return the numbers of finished and of all cells, and of failed cells by status."""
        return "".join([f"{self._n_done}/{self._n_cells}", *(f", {n} {status}" for status, n in self._failed.items())])


def bars_on(console: rich.console.Console, disable: bool = False) -> rich.progress.Progress:
    """Return a progress display of one line: name, bar, counts, remaining time and current tasks."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
    from rich.table import Column

    name = Column(no_wrap=True, overflow="ellipsis", max_width=20)
    current = Column(no_wrap=True, overflow="ellipsis", ratio=1)
    return Progress(
        TextColumn("{task.description}", markup=False, table_column=name),
        BarColumn(16),
        TextColumn("{task.fields[counts]}", markup=False),
        TimeRemainingColumn(compact=True),
        TextColumn("{task.fields[current]}", markup=False, table_column=current),
        console=console,
        transient=True,
        expand=True,
        disable=disable,
    )


@contextmanager
def show_progress(name: str, planned: Sequence[Planned], quiet: bool = False) -> Iterator[Progress]:
    """Show progress on stderr: a bar on a terminal, lines elsewhere, nothing if ``quiet``."""
    from rich.console import Console

    console = Console(stderr=True)
    shows_bar = console.is_terminal and not quiet
    with bars_on(console, disable=not shows_bar) as bars:
        yield Progress(name, planned, bars, lines=not (shows_bar or quiet))


def print_states(planned: Sequence[Planned], policy: str) -> None:
    """Print how many stored rows are of other library versions or machines, or are run again since something has changed.

    ``policy`` says what happens with those of other versions. Machines count only if this run measures times here.
    """
    again = "they are run again" if policy == "rerun" else "versions=rerun runs them again, versions=ignore keeps quiet"
    _print_counts((item.other_versions for item in planned), f"were made with {{}}: {again}")
    if any(item.runs and item.cell.timing for item in planned):
        this = record.kind_of_machine()
        others = (item.machine for item in planned if item.machine != this)
        _print_counts(
            others,
            f"were timed on '{{}}', and this machine is '{this}': times of two kinds of machine do not compare; choose "
            "another folder with name=..., or leave times out with timing=false",
        )
    print_stale(planned)


def print_stale(planned: Sequence[Planned]) -> None:
    """Print how many stored rows are run again since something that they have read has changed."""
    _print_counts((printable(item.stale) for item in planned), "are stale, and run again: {}")


def _print_counts(values: Iterable[str], text: str) -> None:
    """Print how many stored rows have each value that is not empty."""
    for value, count in Counter(filter(None, values)).most_common():
        print(f"bench: {count} stored rows {text.format(value)}", file=sys.stderr)


def print_others(experiment: Experiment, planned: Sequence[Planned], keys: Iterable[str]) -> None:
    """Print how many rows of other settings are stored under the experiment's name, of the stored ``keys``."""
    n_others = len(set(keys) - {item.cell.key for item in planned})
    if n_others and experiment.execution.shard is None:
        print(
            f"bench: stored in '{experiment.directory}' with other settings: {n_others}; name=... chooses another folder",
            file=sys.stderr,
        )


def print_plan(experiment: Experiment, planned: Sequence[Planned], rows: pd.DataFrame, n_references: int) -> None:
    """Print the number of cells, how many are stored, to run and refused, the reasons, the references to compute, and the expected time."""
    if not planned:
        print(empty_shard(experiment))
        return
    n_stored = sum(item.stored for item in planned)
    refusals = [item.refusal for item in planned if item.refusal is not None]
    runs = [item for item in planned if item.runs]
    print(
        f"{experiment.name}: {len(planned)} cell{'s' * (len(planned) != 1)}, {n_stored} stored, {len(runs)} to run, {len(refusals)} refused"
    )
    print_others(experiment, planned, rows["key"])
    print_stale(planned)
    for reason, count in Counter(f"{status}: {reason}" for status, reason in refusals).most_common():
        print(f"  {count} {reason}")
    if n_references:
        most = experiment.reference
        points = min(most.points, 64 * most.samples)
        print(
            f"references to compute: {n_references}, each of at most {most.samples:,} samples and {points:,} points of quadrature"
        )
    if runs:
        seconds = expected_seconds(runs, rows)
        known = f"about {seconds:.0f} s of one worker, without new references"
        print(f"expected time: {'not known before some cells have run' if math.isnan(seconds) else known}")


def empty_shard(experiment: Experiment) -> str:
    """Return the sentence about a shard without cells."""
    number, count = experiment.execution.shard or (1, 1)
    return (
        f"shard {number}/{count} of {experiment.name} is empty: the sweep has {len(cells(experiment))} cells, and those of "
        "one reference are in one shard; 0 to run"
    )
