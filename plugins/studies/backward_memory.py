"""Memory and time of a gradient along the horizon, by what its backward pass keeps."""

from __future__ import annotations

import ctypes
import gc
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.experiment import grid
from bench.experiment.cell import Cell
from bench.experiment.columns import COMMON, Column, Columns, ComparisonRule, bounded, exact, interval, numbers, text
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.views import Chart, Table, Views
from bench.measure import timing
from bench.measure.statistics import ends
from bench.model import param

from . import PARTS, StudyPackage, finite_status, first_batch, relative_error

if TYPE_CHECKING:
    import pandas as pd

    from bench.report.shown import Shown

M_MMAP_THRESHOLD, BLOCK = -3, 1 << 17
"""Option of the C library and its value: blocks of 128 KiB and more return to the system when they are freed. By default the
library raises that limit, and keeps freed blocks for later calls."""
FLOOR = 0.3
"""Error of a measured memory in MiB: the kernel counts resident pages late, so that peaks are 0.1 to 0.25 MiB too low."""
SMALL = 1.0
"""Memory in MiB, about three floors, below which a memory is an upper limit without ratios and orders."""
RANGE = "the range of the calls"
ENDS = ("", "_low", "_high")
"""Endings of the columns of a value and of the ends of its interval."""
SHOWN = ("gradient_s", "process_mb", "gradient_error_rel")
LINES = (
    text("problem"),
    text("method"),
    interval("memory_mb", unit="MiB", label="memory", limit="is_small"),
    interval("less", label="times less memory"),
    interval("gradient_s", label="gradients", format="seconds"),
    interval("longer", label="times the time"),
    interval("order", "p in memory ~ T^p", label="order of memory"),
)
"""The columns of the table with a line per problem and method."""
NOTE = (
    "At the longest horizon of each problem. Memory is the peak of a batch of gradients beyond the memory of the process before. "
    "Ratios are to the experiment's first method, where it has a result. order: p in memory ~ T^p between the two longest "
    "horizons. Intervals are ranges of the measured calls, which contain a median with probability 97% or more, and ratios of "
    f"their ends. Intervals of memory are {FLOOR} MiB wider on both sides, the error of the measurement, and memory below "
    f"{SMALL:.0f} MiB has neither ratio nor order."
)
CELLS_NOTE = (
    "One process per cell. Memory is the peak of a batch of gradients beyond `process`, the memory before. Difference: the "
    "relative distance of the mean gradient from that of the first backend that computes references. "
    f"Intervals of memory are {FLOOR} MiB wider on both sides than the range of the calls, the error of the measurement."
)


@dataclass(frozen=True)
class BackwardMemory(StudyPackage):
    """Measures the peak memory and the time of a batch of gradients on each backend, each cell in its own process."""

    name = "backward_memory"
    axes = PARTS
    columns = Columns.of(
        *bounded(
            "memory_mb",
            "largest resident memory during `samples` gradients beyond the memory before, median over calls",
            "MiB",
            RANGE,
            label="memory",
            measured=True,
        ),
        *bounded(
            "gradient_s",
            "processor time of `samples` gradients on one thread, median over calls",
            "s",
            RANGE,
            label="gradients",
            measured=True,
            format="seconds",
        ),
        Column(
            "process_mb",
            "resident memory before the gradients: libraries, compiled program, theta and noise",
            "MiB",
            label="process",
            measured=True,
        ),
        exact(
            "gradient_error_rel",
            "distance of the mean gradient from that of the backend in `compared_with`, relative to its norm",
            "difference of gradients",
            "difference",
        ),
        text("compared_with", "backend of the gradient that gradient_error_rel compares with"),
        numbers(
            "gradient",
            "mean gradient of the batch, by coordinate of theta",
            comparison=ComparisonRule("vector", "gradient"),
        ),
    )
    timed = fresh_process = True

    calls: int = param(
        6, "measured calls: the range of six contains the median of their distribution with probability 97%", low=6
    )

    def refusal(self, cell: Cell) -> str | None:
        """Return that the backend computes no gradients, or None."""
        return None if "grad" in cell.backend.provides else f"backend {cell.backend.name} computes no gradients"

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column: the mean gradient, and processor times and peaks of memory of some calls.

        The whole batch is one block on one thread, so that processor time is the time on an otherwise idle machine, and
        other load hardly changes it. A first call compiles. Memory freed by earlier calls returns to the system before each.
        """
        problem = session.problem(cell)
        problem.block, problem.threads = cell.samples, 1
        theta, w = problem.program.theta0, first_batch(cell, problem.program.n_noise)
        gradient = problem.grad(theta, w).mean(axis=1)
        seconds, peaks, before = [], [], []
        for _ in range(self.calls):
            gc.collect()
            with suppress(AttributeError, OSError):  # glibc only
                library = ctypes.CDLL(None)
                library.mallopt(M_MMAP_THRESHOLD, BLOCK)
                library.malloc_trim(0)
            timing.reset_peak_memory()
            before.append(timing.peak_memory_mb())
            started = time.process_time()
            problem.grad(theta, w)
            seconds.append(time.process_time() - started)
            peaks.append(timing.peak_memory_mb() - before[-1])
        result = finite_status("the gradient is not finite", gradient) | {
            "gradient": gradient.tolist(),
            **spread("gradient_s", seconds),
            **spread("memory_mb", peaks),
            "process_mb": float(np.median(before)),
            "compared_with": "",
        }
        if cell.ranked_backends:
            other = session.problems.of(cell.ranked_backends[0], cell)
            expected = other.grad(other.program.theta0, w).mean(axis=1)
            error = relative_error(gradient, expected)
            result |= {"compared_with": cell.ranked_backends[0].name, "gradient_error_rel": error}
        return result

    def show(self, experiment: Experiment, rows: pd.DataFrame) -> Views:
        """Return the tables of the longest horizon and of all cells, and the charts of memory and time."""
        from bench.report.shown import Shown

        shown = Shown(experiment, rows, along=["horizon"])
        tried = with_error(shown.rows)
        own: list[Column | str] = [COMMON["horizon"], shown.column("memory_mb", digits=3, limit="is_small"), *SHOWN]
        title, always = "memory and time of a backward pass", ("scene", "backend")
        cells = shown.cells(own, title, [CELLS_NOTE], always, tried, terminal=False)
        has_result = (tried["status"] == "ok") & tried["memory_mb"].notna()
        if not has_result.any():
            return Views([cells])
        # the first method is the experiment's first, in whatever order rows were stored
        places = {cell.key: place for place, cell in enumerate(grid.cells(experiment))}
        tried = tried.iloc[tried["key"].map(places).fillna(len(places)).to_numpy().argsort(kind="stable")]
        first, good = str(tried["method"].iloc[0]), tried[has_result]
        lines = longest(good, first)
        table = Table(
            "backward_memory_methods",
            lines,
            LINES,
            "Memory and time of a backward pass",
            [NOTE],
            terminal=True,
            page=True,
        )
        return Views([table, cells], _charts(shown, good))


def spread(name: str, values: list[float]) -> dict[str, float]:
    """Return the median of some values as column ``name``, and their range as ``name_low`` and ``name_high``.

    The range of n independent values contains their distribution's median with probability 1 - 2^(1 - n).
    """
    return ends(name, (float(np.median(values)), min(values), max(values)))


# ------------------------------------------------------------------------------------------------- what is shown


def with_error(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows whose intervals of memory contain the error of the measurement, and which memories are only limits.

    A limit is the upper end of its interval, at least :data:`SMALL`.
    """
    memory, is_small = rows["memory_mb"], rows["memory_mb"] < SMALL
    low, high = (rows["memory_mb_low"] - FLOOR).clip(lower=0.0), rows["memory_mb_high"] + FLOOR
    limit = high.clip(lower=SMALL)
    return rows.assign(
        memory_mb=memory.mask(is_small, limit),
        memory_mb_low=low.mask(is_small, 0.0),
        memory_mb_high=high.mask(is_small, limit),
        is_small=is_small,
    )


def longest(good: pd.DataFrame, first: str) -> pd.DataFrame:
    """Return a line per problem and method at the problem's longest horizon, with ratios to the method ``first``."""
    import pandas as pd

    kept = [f"{name}{end}" for name in ("memory_mb", "gradient_s") for end in ENDS]
    lines = []
    for _, part in good.groupby("problem", sort=False):
        is_last = part["horizon"] == part["horizon"].max()
        last = part[is_last].drop_duplicates("method", keep="last").set_index("method", drop=False)
        before = part[~is_last].sort_values("horizon").drop_duplicates("method", keep="last")
        before = before.set_index("method").reindex(last.index)
        base = last.reindex([first] * len(last)).set_index(last.index).mask(last["method"] == first)
        order = np.log(ratio(last, before, "memory_mb")).div(np.log(last["horizon"] / before["horizon"]), axis=0)
        ratios = {"less": ratio(base, last, "memory_mb"), "longer": ratio(last, base, "gradient_s"), "order": order}
        shown = last[["problem", "method", "horizon", "is_small", *kept]]
        lines.append(pd.concat([shown, *(ratios[name].add_prefix(name) for name in ratios)], axis=1))
    return pd.concat(lines, ignore_index=True)


def ratio(a: pd.DataFrame, b: pd.DataFrame, name: str) -> pd.DataFrame:
    """Return the ratio of a column of aligned rows with its ends; missing where a memory is only an upper limit.

    The interval divides the ends of both intervals, so it covers at least as often as both of them together.
    """
    import pandas as pd

    above, below = ([one[f"{name}{end}"].astype(float) for end in ENDS] for one in (a, b))
    found = pd.DataFrame(dict(zip(ENDS, (above[0] / below[0], above[1] / below[2], above[2] / below[1]), strict=True)))
    return found.mask(a["is_small"].eq(True) | b["is_small"].eq(True)) if name == "memory_mb" else found


def _charts(shown: Shown, good: pd.DataFrame) -> list[Chart]:
    """Return the charts of memory and of time along the horizon, a panel per problem and a line per method."""
    horizon = shown.column("horizon", label="horizon T", log=True)
    samples = " or ".join(f"{count:g}" for count in good["samples"].unique())
    drawn = {
        "backward_memory": shown.column("memory_mb", limit="is_small", log=True),
        "backward_time": shown.column("gradient_s", label="time of a batch of gradients", log=True),
    }
    small = f"; little is known below {SMALL:.0f} MiB"
    return [
        Chart(
            name,
            good,
            [horizon],
            [y],
            series="method",
            panel="problem",
            across=2,
            title=f"How much {what} does the gradient of a long rollout take?",
            subtitle=f"batches of {samples} rollouts on one thread, median of calls" + small * (what == "memory"),
        )
        for what, (name, y) in zip(("memory", "time"), drawn.items(), strict=True)
    ]
