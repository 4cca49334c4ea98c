"""Time of the harness's own work: planning, resuming, listing, and what a cell costs beside its estimates."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from bench import config, runner, studies
from bench.benchself.lines import Line
from bench.grid import cells
from bench.store import Store

SIDE, QUICK_SIDE = 100, 5
"""Values on each of the two axes of the planned sweep."""
CELLS, QUICK_CELLS = 500, 40
"""Cells of the run that the overhead of a cell is taken from."""
SMALL = ("scenes=[quadratic]", "backends=[numpy]", "estimators=[fobg]", "samples=16", "repeats=4")


def lines(quick: bool) -> Iterator[Line]:
    """Every figure of the harness, each command in a process of its own as a user starts it."""
    with tempfile.TemporaryDirectory() as folder:
        side = QUICK_SIDE if quick else SIDE
        sweep = [
            *SMALL,
            f"sweep.seed=[{_range(side)}]",
            f"sweep.sigma=[{_range(side, 1)}]",
            "name=many",
            f"results_dir={folder}",
        ]
        yield Line(f"planning {side**2} cells", _fastest("plan", *sweep), "s", 2.0)
        experiment = config.load(sweep)
        study = studies.find(experiment.study)
        store = Store(experiment.directory, study.COLUMNS)
        store.prepare()
        for cell in cells(experiment):
            store.append(runner.blank(experiment, cell, study) | {"status": "ok"})
        store.compact()
        yield Line(f"resuming {side**2} stored cells", _fastest("plan", *sweep), "s", 3.0, note="until none is missing")
        yield Line("python -m bench list", _fastest("list"), "s", 1.0)
        yield _overhead(Path(folder), QUICK_CELLS if quick else CELLS)


def _range(count: int, start: int = 0) -> str:
    return ",".join(map(str, range(start, start + count)))


def _fastest(*words: str, calls: int = 3) -> float:
    seconds = []
    for _ in range(calls):
        started = time.perf_counter()
        subprocess.run([sys.executable, "-m", "bench", *words], check=True, capture_output=True)
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def _overhead(folder: Path, count: int) -> Line:
    """Seconds between the first cell stored and the last, less those spent in estimates, per cell."""
    words = [*SMALL, f"sweep.seed=[{_range(count)}]", "name=overhead", f"results_dir={folder}"]
    subprocess.run([sys.executable, "-m", "bench", *words], check=True, capture_output=True)
    experiment = config.load(words)
    rows = Store(experiment.directory, studies.find(experiment.study).COLUMNS).load().sort_values("stored_at")
    later = rows[rows["stored_at"] > rows["stored_at"].iloc[0]]
    spent = rows["stored_at"].iloc[-1] - rows["stored_at"].iloc[0] - later["estimates_s"].sum()
    return Line(
        "overhead of a cell", 1e3 * spent / len(later), "ms", 1.0, note="mean time of a cell less its estimates"
    )
