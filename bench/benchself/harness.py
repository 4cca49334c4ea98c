"""Times the harness's own work: planning, resuming, listing, and the cost of a cell besides its estimates."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from bench.benchself.lines import SpeedRow
from bench.experiment import config
from bench.experiment.experiment import Experiment
from bench.experiment.grid import cells
from bench.run.execute import store_of
from bench.run.plan import plan
from bench.run.tasks import blank_row

SIDE, QUICK_SIDE = 100, 5
"""Values on each of the two axes of the planned sweep."""
CELLS, QUICK_CELLS = 500, 40
"""Number of cells in the run that measures the overhead per cell."""
SMALL = ("scenes=[quadratic]", "backends=[numpy]", "estimators=[fobg]", "samples=16", "repeats=4")


def lines(quick: bool) -> Iterator[SpeedRow]:
    """Measure every figure of the harness, each command in a process of its own, as a user starts it."""
    with tempfile.TemporaryDirectory() as folder:
        side = QUICK_SIDE if quick else SIDE
        sweep = [
            *SMALL,
            f"sweep.seed=[{_range(side)}]",
            f"sweep.sigma=[{_range(side, 1)}]",
            "name=many",
            f"results_dir={folder}",
        ]
        yield SpeedRow(f"planning {side**2} cells", _fastest("plan", *sweep), "s", 2.0)
        experiment = config.load(sweep)
        store_all(experiment)
        yield SpeedRow(
            f"resuming {side**2} stored cells", _fastest("plan", *sweep), "s", 3.0, note="until none is missing"
        )
        yield SpeedRow("python -m bench list", _fastest("list"), "s", 1.0)
        yield _overhead(Path(folder), QUICK_CELLS if quick else CELLS)


def store_all(experiment: Experiment) -> None:
    """Store a row for every cell of an experiment, so that a plan of it resumes all of them and runs none."""
    store = store_of(experiment)
    store.prepare()
    store.append(*(blank_row(experiment, cell) | {"status": "ok"} for cell in cells(experiment)))
    store.compact()
    assert all(item.stored for item in plan(experiment, store)), "cells that are stored are planned again"


def _range(count: int, start: int = 0) -> str:
    return ",".join(map(str, range(start, start + count)))


def _fastest(*words: str, calls: int = 3) -> float:
    seconds = []
    for _ in range(calls):
        started = time.perf_counter()
        subprocess.run([sys.executable, "-m", "bench", *words], check=True, capture_output=True)
        seconds.append(time.perf_counter() - started)
    # other load can only add time, so the fastest call is nearest to the command's own cost
    return min(seconds)


def _overhead(folder: Path, count: int) -> SpeedRow:
    """Return the seconds per cell between the first cell stored and the last, less those spent in estimates."""
    words = [*SMALL, f"sweep.seed=[{_range(count)}]", "name=overhead", f"results_dir={folder}"]
    subprocess.run([sys.executable, "-m", "bench", *words], check=True, capture_output=True)
    experiment = config.load(words)
    rows = store_of(experiment).load().sort_values("stored_at")
    later = rows[rows["stored_at"] > rows["stored_at"].iloc[0]]
    spent = rows["stored_at"].iloc[-1] - rows["stored_at"].iloc[0] - later["estimates_s"].sum()
    return SpeedRow(
        "overhead of a cell", 1e3 * spent / len(later), "ms", 1.0, note="mean time of a cell less its estimates"
    )
