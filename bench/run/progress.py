"""Prints the plan of a run and its progress as plain text, since names may contain terminal codes or rich markup."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from rich.cells import cell_len, set_cell_size

from bench.errors import printable
from bench.experiment.cell import Cell
from bench.experiment.experiment import Experiment
from bench.run import record
from bench.run.plan import Planned, expected_seconds

if TYPE_CHECKING:
    import pandas as pd
    import rich.console
    import rich.progress

FIRST_LINE_S, LINE_S = 5.0, 10.0
"""Seconds before the first line and between lines where the output is not a terminal."""
FEWEST_CELLS, FEWEST_SECONDS = 6, 5.0
"""Cells that have to be finished, and seconds of cells, before a remaining time is estimated."""
STEADY = 2.0
"""Largest ratio of the estimates from all, the latest half and the latest quarter of the cells, for a time that is shown."""
NAME_WIDTH = 20
"""Most characters of the experiment's name beside a bar."""
BAR_WIDTHS = (10, 24)
"""Characters of a bar on a narrow and on a wide terminal."""
NOT_FAILED = ("ok", "unsupported", "waiting")
"""Statuses that are not counted as failures."""


class Progress:
    """Counts cells (done, failed, stored before) and estimates the remaining time; shows nothing itself."""

    def __init__(self, name: str, planned: Sequence[Planned]) -> None:
        self._name, self._n_cells = name, len(planned)
        self._n_stored = sum(item.stored for item in planned)
        self._n_due = sum(item.runs for item in planned)
        self._current = ""
        self._failed: Counter[str] = Counter()
        self._started = time.monotonic()
        self._ends: list[float] = []
        """When each cell that had to be simulated was finished; refused cells take no time."""
        self._n_done = 0

    def finished(self, cell: Cell, row: dict[str, Any]) -> None:
        """Count one cell that is finished and stored."""
        self._n_done += 1
        if row["status"] not in ("unsupported", "unavailable", "waiting"):
            self._ends.append(time.monotonic())
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
        """Return the numbers of finished and of all cells, and of failed cells by status."""
        return "".join(
            [
                f"{self._n_stored + self._n_done}/{self._n_cells}",
                *(f", {n} {status}" for status, n in self._failed.items()),
            ]
        )

    def _remaining(self) -> str:
        """Return the remaining time as text; empty until it can be estimated, see :func:`remaining_seconds`."""
        seconds = remaining_seconds(self._ends, self._n_due, time.monotonic())
        return "" if math.isnan(seconds) else f"about {_rounded(seconds)} left"


def remaining_seconds(ends: Sequence[float], n_due: int, now: float) -> float:
    """Estimate the seconds until all of ``n_due`` cells are finished, from the times at which cells finished.

    Returns NaN until the estimate means something: until some cells and seconds are over, and while the rate of all
    cells, of their latest half and of their latest quarter, with the time since the last one, give estimates that
    differ by more than a factor of :data:`STEADY`. The first cell only starts the clock, since references and compilation precede it.
    """
    if len(ends) < FEWEST_CELLS or ends[-1] - ends[0] < FEWEST_SECONDS:
        return math.nan
    n_left = max(n_due - len(ends), 0)
    last = len(ends) - 1
    starts = [0, len(ends) // 2, min(3 * len(ends) // 4, last - 2)]
    estimates = [(now - ends[start]) / (last - start) * n_left for start in starts]
    return estimates[1] if n_left and max(estimates) <= STEADY * min(estimates) else math.nan


def _rounded(seconds: float) -> str:
    """Return a time as text, as coarse as an estimate of it: ``25 s``, ``4 min``, ``2.5 h``."""
    if seconds < 95:
        return f"{max(5 * math.ceil(seconds / 5), 5)} s"
    return f"{seconds / 60:.0f} min" if seconds < 95 * 60 else f"{seconds / 3600:.1f} h"


class Lines(Progress):
    """Prints a plain line every 10 s."""

    def __init__(self, name: str, planned: Sequence[Planned]) -> None:
        super().__init__(name, planned)
        self._printed_at = self._started + FIRST_LINE_S - LINE_S
        if self._n_stored:
            print(f"{name}: {self._n_stored} of {self._n_cells} cells are stored", file=sys.stderr)

    def show(self) -> None:
        """Print a line, unless the last one is less than 10 s old, or the run is younger than 5 s."""
        if time.monotonic() - self._printed_at > LINE_S:
            self._printed_at = time.monotonic()
            parts = [f"{self._counts()} cells", self._remaining(), self._current and f"now {self._current}"]
            print(f"{self._name}: {'; '.join(part for part in parts if part)}", file=sys.stderr)


class Bar(Progress):
    """Shows a bar on a terminal, with the counts, the remaining or else the elapsed time, and the current tasks."""

    def __init__(self, name: str, planned: Sequence[Planned], bars: rich.progress.Progress) -> None:
        super().__init__(name, planned)
        self._bars = bars
        self._task = bars.add_task(
            name, total=self._n_cells, completed=self._n_stored, counts=self._counts(), left="", current=""
        )

    def working(self, tasks: str) -> None:
        """Set the names of the tasks being worked on; redraws the bar only if they have changed."""
        if tasks != self._current:
            super().working(tasks)

    def show(self) -> None:
        """Update the bar, and the text beside it."""
        self._bars.update(
            self._task, completed=self._n_stored + self._n_done, counts=self._counts(), left=self._remaining(),
            current=self._current,
        )  # fmt: skip


def bars_on(console: rich.console.Console) -> rich.progress.Progress:
    """Return a progress display of one line, as wide as the console at most: see :func:`progress_line`."""
    from rich.progress import Progress, ProgressColumn, Task
    from rich.text import Text

    class Line(ProgressColumn):
        def render(self, task: Task) -> Text:
            elapsed = str(timedelta(seconds=int(task.elapsed or 0)))
            facts = [task.fields["counts"], task.fields["left"] or elapsed]
            share = task.completed / task.total if task.total else 1.0
            name, filled, empty, rest = progress_line(
                console.width - 1, printable(task.description), share, facts, printable(task.fields["current"])
            )
            full, open_ = ("━", "─") if "utf" in console.encoding else ("#", "-")
            return Text.assemble(name, (full * filled, "bar.complete"), (open_ * empty, "bar.back"), rest)

    return Progress(Line(), console=console, transient=True)


def progress_line(width: int, name: str, share: float, facts: Sequence[str], current: str) -> tuple[str, int, int, str]:
    """Return the parts of a line of ``width`` characters at most: name, filled and empty part of the bar, and the rest.

    The facts are shown first. What they leave goes to a short bar, then to the name, to a longer bar, and to the current
    tasks.
    """
    text = "  ".join(filter(None, facts))[:width]
    free = width - cell_len(text)
    bar = BAR_WIDTHS[0] if free > BAR_WIDTHS[0] else 0
    free -= bar + 1 if bar else 0
    name = set_cell_size(name, min(cell_len(name), NAME_WIDTH, free - 1)) if free > 1 else ""
    free -= cell_len(name) + 1 if name else 0
    wider = min(free, BAR_WIDTHS[1] - BAR_WIDTHS[0]) if bar else 0
    free -= wider
    bar += wider
    filled = int(bar * min(max(share, 0.0), 1.0))
    tasks = f"  {set_cell_size(current, min(cell_len(current), free - 2))}" if current and free > 8 else ""
    return (f"{name} " if name else ""), filled, bar - filled, (" " if bar else "") + text + tasks


@contextmanager
def show_progress(name: str, planned: Sequence[Planned], quiet: bool = False) -> Iterator[Progress]:
    """Show progress on stderr: a bar on a terminal, lines elsewhere, nothing if ``quiet``."""
    from rich.console import Console

    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield Progress(name, planned) if quiet else Lines(name, planned)
        return
    with bars_on(console) as bars:
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
        known = f"about {seconds:.0f} s of one worker, without new references"
        print(f"expected time: {'not known before some cells have run' if math.isnan(seconds) else known}")


def _older_code(runs: Sequence[Planned]) -> str:
    """Return, in brackets, how many cells older code has stored, and the parameters added since; empty if none."""
    count = sum(item.by_older_code for item in runs)
    added = sorted({name for item in runs for name in item.added})
    return f" ({count} stored by older code{', without ' if added else ''}{', '.join(added)})" if count else ""
