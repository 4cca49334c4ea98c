"""Prints the plan of a run and its progress as plain text, since names may contain terminal codes or rich markup."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.run import record
from bench.run.plan import Planned, expected_seconds

if TYPE_CHECKING:
    import pandas as pd
    import rich.progress

LINE_S = 10.0
"""Seconds between lines where the output is not a terminal."""
NOT_FAILED = ("ok", "unsupported")
"""Statuses that are not counted as failures."""


class Progress:
    """Counts cells (done, failed, stored before) and estimates the remaining time; shows nothing itself."""

    def __init__(self, name: str, planned: Sequence[Planned]) -> None:
        self._name, self._n_cells = name, len(planned)
        self._n_stored = sum(item.stored for item in planned)
        self._n_done = 0
        self._current = ""
        self._failed: Counter[str] = Counter()
        self._started = time.monotonic()

    def finished(self, cell: Cell, row: dict[str, Any]) -> None:
        """Count one cell that is finished and stored."""
        self._n_done += 1
        if row["status"] not in NOT_FAILED:
            self._failed[row["status"]] += 1
        self.show()

    def working(self, tasks: str) -> None:
        """Set the names of the tasks being worked on."""
        self._current = tasks
        self.show()

    def show(self) -> None:
        """Show the current state of the run; shows nothing in this class."""

    def _counts(self) -> str:
        failed = "".join(f", {count} {status}" for status, count in self._failed.items())
        return f"{self._n_stored + self._n_done}/{self._n_cells} cells ({self._n_stored} stored before{failed})"

    def _remaining(self) -> str:
        if not self._n_done:
            return ""
        n_cells = self._n_cells - self._n_stored - self._n_done
        return f"about {(time.monotonic() - self._started) / self._n_done * n_cells:.0f} s left"


class Lines(Progress):
    """Prints a plain line every 10 s."""

    def __init__(self, name: str, planned: Sequence[Planned]) -> None:
        super().__init__(name, planned)
        self._printed_at = self._started
        if self._n_stored:
            print(f"{name}: {self._n_stored} of {self._n_cells} cells are stored", file=sys.stderr)

    def show(self) -> None:
        """Print a line, unless the last one is less than 10 s old."""
        if time.monotonic() - self._printed_at > LINE_S:
            self._printed_at = time.monotonic()
            parts = [self._counts(), self._remaining(), self._current and f"now {self._current}"]
            print(f"{self._name}: {', '.join(part for part in parts if part)}", file=sys.stderr)


class Bar(Progress):
    """Shows a bar on a terminal."""

    def __init__(self, name: str, planned: Sequence[Planned], bars: rich.progress.Progress) -> None:
        super().__init__(name, planned)
        self._bars = bars
        self._task = bars.add_task(name, total=self._n_cells, completed=self._n_stored, note="")

    def working(self, tasks: str) -> None:
        """Set the names of the tasks being worked on; redraws the bar only if they have changed."""
        if tasks != self._current:
            super().working(tasks)

    def show(self) -> None:
        """Update the bar, and the text beside it."""
        note = ", ".join(part for part in (self._counts(), self._remaining(), self._current) if part)
        self._bars.update(self._task, completed=self._n_stored + self._n_done, note=note)


@contextmanager
def show_progress(name: str, planned: Sequence[Planned], quiet: bool = False) -> Iterator[Progress]:
    """Show progress on stderr: a bar on a terminal, lines elsewhere, nothing if ``quiet``."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield Progress(name, planned) if quiet else Lines(name, planned)
        return
    name_column = TextColumn("{task.description}", markup=False)
    with Bars(
        name_column, BarColumn(20), TimeElapsedColumn(), TextColumn("{task.fields[note]}", markup=False),
        console=console, transient=True,
    ) as bars:  # fmt: skip
        yield Bar(name, planned, bars)


def print_versions(planned: Sequence[Planned], policy: str) -> None:
    """Print how many stored rows were computed with other library versions, and whether they are run again."""
    counts = Counter(item.other_versions for item in planned if item.other_versions)
    for versions, count in counts.most_common():
        action = (
            "they are run again" if policy == "rerun" else "versions=rerun runs them again, versions=ignore keeps quiet"
        )
        print(f"bench: {count} stored rows were made with {versions}: {action}", file=sys.stderr)


def print_machines(planned: Sequence[Planned], launcher: str) -> None:
    """Print how many stored rows were timed on another kind of machine, if this run measures times here."""
    this = record.kind_of_machine()
    others = Counter(item.machine for item in planned if item.machine not in ("", this))
    if launcher == "local" and others and any(item.runs and item.cell.timing for item in planned):
        for machine, count in others.most_common():
            print(
                f"bench: {count} stored rows were timed on '{machine}', and this machine is '{this}': times of two kinds of "
                "machine do not compare; choose another folder with name=..., or leave times out with timing=false",
                file=sys.stderr,
            )


def print_plan(experiment: Experiment, planned: Sequence[Planned], rows: pd.DataFrame) -> None:
    """Print the number of cells, how many are stored, to run and refused, the reasons, and the expected time."""
    n_stored = sum(item.stored for item in planned)
    refusals = [item.refusal for item in planned if item.refusal is not None]
    runs = [item for item in planned if item.runs]
    print(
        f"{experiment.name}: {len(planned)} cells, {n_stored} stored, {len(runs)} to run{_older_code(runs)}, "
        f"{len(refusals)} refused"
    )
    for reason, count in Counter(f"{status}: {reason}" for status, reason in refusals).most_common():
        print(f"  {count} {reason}")
    if runs:
        seconds = expected_seconds(runs, rows)
        duration = "unknown until some cells have run" if math.isnan(seconds) else f"about {seconds:.0f} s"
        print(f"expected time: {duration} of one worker, new references not counted")


def _older_code(runs: Sequence[Planned]) -> str:
    """Return, in brackets, how many cells older code has stored, and the parameters added since; empty if none."""
    count = sum(item.by_older_code for item in runs)
    added = sorted({name for item in runs for name in item.added})
    return f" ({count} stored by older code{', without ' if added else ''}{', '.join(added)})" if count else ""
