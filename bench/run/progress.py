"""Shows progress before and during a run, as plain text: names may hold what a terminal or rich takes for markup."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd
    import rich.progress

    from bench.experiment.cell import Cell
    from bench.experiment.experiment import Experiment
    from bench.run.plan import Planned


SPEAK_S = 10.0
"""Seconds between lines where the output is not a terminal."""
FINE = ("ok", "unsupported")
"""Statuses that are not counted as failures."""


class Progress:
    """Counts cells (done, failed, stored before) and estimates the time left; subclasses write it out."""

    def __init__(self, name: str, planned: Sequence[Planned]) -> None:
        self._name, self._total = name, len(planned)
        self._stored = sum(item.stored for item in planned)
        self._done = 0
        self._failed: Counter[str] = Counter()
        self._started = time.monotonic()

    def finished(self, cell: Cell, row: dict[str, Any]) -> None:
        """Count one cell that is finished and stored."""
        self._done += 1
        if row["status"] not in FINE:
            self._failed[row["status"]] += 1
        self.show()

    def working(self, on: str) -> None:
        """Take note of what the workers are working on."""

    def show(self) -> None:
        """Show how far the run has come."""

    def _counts(self) -> str:
        failed = "".join(f", {count} {status}" for status, count in self._failed.items())
        return f"{self._stored + self._done}/{self._total} cells ({self._stored} stored before{failed})"

    def _left(self) -> str:
        if not self._done:
            return ""
        left = (time.monotonic() - self._started) / self._done * (self._total - self._stored - self._done)
        return f"about {left:.0f} s left"


class Lines(Progress):
    """A plain line every 10 s."""

    def __init__(self, name: str, planned: Sequence[Planned]) -> None:
        super().__init__(name, planned)
        self._spoken, self._on = self._started, ""
        if self._stored:
            print(f"{name}: {self._stored} of {self._total} cells are stored", file=sys.stderr)

    def working(self, on: str) -> None:
        """Keep the text for the next line."""
        self._on = on
        self.show()

    def show(self) -> None:
        """Print a line, unless there was one just now."""
        if time.monotonic() - self._spoken > SPEAK_S:
            self._spoken = time.monotonic()
            parts = [self._counts(), self._left(), self._on and f"now {self._on}"]
            print(f"{self._name}: {', '.join(part for part in parts if part)}", file=sys.stderr)


class Bar(Progress):
    """A bar on a terminal."""

    def __init__(self, name: str, planned: Sequence[Planned], shown: rich.progress.Progress) -> None:
        super().__init__(name, planned)
        self._shown, self._on = shown, ""
        self._task = shown.add_task(name, total=self._total, completed=self._stored, note="")

    def working(self, on: str) -> None:
        """Show the text beside the bar."""
        if on != self._on:
            self._on = on
            self.show()

    def show(self) -> None:
        """Move the bar."""
        note = ", ".join(part for part in (self._counts(), self._left(), self._on) if part)
        self._shown.update(self._task, completed=self._stored + self._done, note=note)


@contextmanager
def of(name: str, planned: Sequence[Planned], quiet: bool = False) -> Iterator[Progress]:
    """Show progress on stderr: a bar on a terminal, lines elsewhere, nothing if ``quiet``."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Shown

    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield Progress(name, planned) if quiet else Lines(name, planned)
        return
    name_column = TextColumn("{task.description}", markup=False)
    with Shown(
        name_column, BarColumn(20), TimeElapsedColumn(), TextColumn("{task.fields[note]}", markup=False),
        console=console, transient=True,
    ) as shown:  # fmt: skip
        yield Bar(name, planned, shown)


def print_versions(planned: Sequence[Planned], policy: str) -> None:
    """Print which stored rows were made with other library versions, and how they are treated."""
    aged = Counter(item.aged for item in planned if item.aged)
    for versions, count in aged.most_common():
        done = (
            "they are run again" if policy == "rerun" else "versions=rerun runs them again, versions=ignore keeps quiet"
        )
        print(f"bench: {count} stored rows were made with {versions}: {done}", file=sys.stderr)


def print_machines(planned: Sequence[Planned], launcher: str) -> None:
    """Print where stored times are of another kind of machine than those that are about to be measured here."""
    from bench.run.record import kind_of_machine

    here = kind_of_machine()
    others = Counter(item.machine for item in planned if item.machine not in ("", here))
    if launcher == "local" and others and any(item.runs and item.cell.timing for item in planned):
        for machine, count in others.most_common():
            print(
                f"bench: {count} stored rows were timed on '{machine}', and this machine is '{here}': times of two kinds of "
                "machine do not compare; choose another folder with name=..., or leave times out with timing=false",
                file=sys.stderr,
            )


def print_plan(experiment: Experiment, planned: list[Planned], rows: pd.DataFrame) -> None:
    """Print the number of cells, how many are stored, which are refused and why, and the expected time."""
    stored = [item for item in planned if item.stored]
    refused = [item for item in planned if item.refusal is not None]
    runs = [item for item in planned if item.runs]
    print(f"{experiment.name}: {len(planned)} cells, {len(stored)} stored, {len(runs)} to run, {len(refused)} refused")
    reasons = Counter(f"{status}: {reason}" for status, reason in (item.refusal for item in refused if item.refusal))
    for reason, count in reasons.most_common():
        print(f"  {count} {reason}")
    from bench.run.plan import expected_seconds

    seconds = expected_seconds(runs, rows)
    if runs:
        duration = "unknown until some cells have run" if math.isnan(seconds) else f"about {seconds:.0f} s"
        print(f"expected time: {duration} of one worker, new references not counted")
