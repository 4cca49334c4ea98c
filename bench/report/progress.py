"""What is shown before and during a run."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

    from bench.grid import Experiment
    from bench.runner import Planned


@contextmanager
def bar(name: str, total: int, stored: int) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A progress bar with the expected time left; a line every 10 s where the output is no terminal."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    failed: Counter[str] = Counter()
    if not console.is_terminal:
        started = spoken = time.monotonic()
        done = 0

        def say(row: dict[str, Any]) -> None:
            nonlocal spoken, done
            done += 1
            failed[row["status"]] += row["status"] not in ("ok", "unsupported")
            now = time.monotonic()
            if now - spoken > 10:
                spoken = now
                left = (now - started) / done * (total - stored - done)
                print(f"{name}: {stored + done}/{total} cells, about {left:.0f} s left", file=sys.stderr)

        if stored:
            print(f"{name}: {stored} of {total} cells are stored", file=sys.stderr)
        yield say
        return

    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"),
        TimeRemainingColumn(), TextColumn("{task.fields[note]}"),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(name, total=total, completed=stored, note="")

        def step(row: dict[str, Any]) -> None:
            if row["status"] not in ("ok", "unsupported"):
                failed[row["status"]] += 1
            bad = ", ".join(f"{count} {status}" for status, count in failed.items())
            progress.update(task, advance=1, note=f"{row['scene']} {row['backend']} {row['estimator']} {bad}")

        yield step


def print_plan(experiment: Experiment, planned: list[Planned], rows: pd.DataFrame) -> None:
    """Cells, how many are stored, which are refused and why, and the expected time from stored timings."""
    stored = [item for item in planned if item.stored]
    refused = [item for item in planned if item.refusal is not None]
    runs = [item for item in planned if item.runs]
    print(f"{experiment.name}: {len(planned)} cells, {len(stored)} stored, {len(runs)} to run, {len(refused)} refused")
    reasons = Counter(f"{status}: {reason}" for status, reason in (item.refusal for item in refused if item.refusal))
    for reason, count in reasons.most_common():
        print(f"  {count} {reason}")
    seconds = expected_seconds(runs, rows)
    if runs:
        known = "unknown until some cells have run" if math.isnan(seconds) else f"about {seconds:.0f} s"
        print(f"expected time: {known}, references and compilation not counted")


def expected_seconds(runs: list[Planned], rows: pd.DataFrame) -> float:
    """Seconds the cells should take, from the stored time per estimate of like cells scaled to their samples."""
    if not runs:
        return 0.0
    ok = rows[rows["status"] == "ok"]
    if ok.empty:
        return math.nan
    per_sample = ok["time_s"] / ok["samples"]
    like = per_sample.groupby([ok["backend"], ok["estimator"]]).median().to_dict()
    typical = float(per_sample.median())
    return sum(
        like.get((item.cell.backend.name, item.cell.estimator.name), typical) * item.cell.samples * item.cell.repeats
        for item in runs
    )
