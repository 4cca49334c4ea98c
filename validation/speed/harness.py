"""Times the harness: planning, resuming, listing, and the overhead per cell."""

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench.experiment import config
from bench.experiment.grid import cells
from bench.run.execute import store_of
from bench.run.plan import plan
from bench.run.tasks import blank_row
from speed.speed_rows import SpeedRow

SIDE, QUICK_SIDE = 100, 5
"""Number of values on each of the two axes of the planned sweep."""
CELLS, QUICK_CELLS = 500, 40
"""Number of cells in the run that measures the overhead per cell."""
SMALL = ("scenes=[quadratic]", "backends=[numpy]", "estimators=[fobg]", "samples=16", "repeats=4")


def measure_commands(quick):
    """Time the commands of the harness, each in a separate process, as for a user."""
    with tempfile.TemporaryDirectory() as folder:
        side = QUICK_SIDE if quick else SIDE
        sweep = [
            *SMALL,
            f"sweep.seed=[{_range_text(side)}]",
            f"sweep.sigma=[{_range_text(side, 1)}]",
            "name=many",
            f"results_dir={folder}",
        ]
        yield SpeedRow(f"planning {side**2} cells", _fastest_call("plan", *sweep), "s", 2.0)
        experiment = config.load(sweep)
        store_all(experiment)
        yield SpeedRow(
            f"resuming {side**2} stored cells", _fastest_call("plan", *sweep), "s", 3.0, note="until no cell is missing"
        )
        yield list_row()
        yield _overhead_per_cell(Path(folder), QUICK_CELLS if quick else CELLS)


def list_row():
    """Return the processor seconds of ``list``, in all its processes: other load hardly changes them."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    _fastest_call("list", calls=5)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / 5
    return SpeedRow("python -m bench list", seconds, "s", 1.0, note="processor time, mean of 5 calls")


def store_all(experiment):
    """Store a row for every cell of an experiment, so that its plan has nothing to run."""
    store = store_of(experiment)
    store.prepare()
    store.append(*(blank_row(experiment, cell) | {"status": "ok"} for cell in cells(experiment)))
    store.compact()
    assert all(item.stored for item in plan(experiment, store)), "stored cells are planned again"


def _range_text(count, start=0):
    return ",".join(map(str, range(start, start + count)))


def _fastest_call(*words, calls=3):
    seconds = []
    for _ in range(calls):
        started = time.perf_counter()
        subprocess.run([sys.executable, "-m", "bench", *words], check=True, capture_output=True)
        seconds.append(time.perf_counter() - started)
    # other load only adds time, so the fastest call is closest to the cost of the command
    return min(seconds)


def _overhead_per_cell(folder, count):
    """Return the time per cell [ms] between the first and the last stored cell, without the time of their estimates."""
    words = [*SMALL, f"sweep.seed=[{_range_text(count)}]", "name=overhead", f"results_dir={folder}"]
    subprocess.run([sys.executable, "-m", "bench", *words], check=True, capture_output=True)
    experiment = config.load(words)
    rows = store_of(experiment).load().sort_values("stored_at")
    timed = rows[rows["stored_at"] > rows["stored_at"].iloc[0]]
    spent = rows["stored_at"].iloc[-1] - rows["stored_at"].iloc[0] - timed["estimates_s"].sum()
    return SpeedRow(
        "overhead per cell", 1e3 * spent / len(timed), "ms", 1.0, note="mean time per cell without its estimates"
    )
