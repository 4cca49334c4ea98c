"""What the study of backward passes shows: memory and time of gradients along the horizon, by method."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from bench.experiment import grid
from bench.experiment.columns import interval, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Table, Views
from bench.report.shown import Shown

FLOOR = 0.3
"""Error of a measured memory in MiB: the kernel counts resident pages late, so that peaks are 0.1 to 0.25 MiB too low."""
SMALL = 1.0
"""Memory in MiB, about three floors, below which a memory is an upper limit without ratios and orders."""
ENDS = ("", "_low", "_high")
"""Endings of the columns of a value and of the ends of its interval."""
SHOWN = ("memory_mb", "gradient_s", "process_mb", "gradient_error_rel")
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


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the tables of the longest horizon and of all cells, and the charts of memory and time."""
    shown = Shown(experiment, rows, along=["horizon"])
    tried = with_error(shown.rows)
    own = [shown.column(name, digits=3) for name in SHOWN]
    own[0] = replace(own[0], limit="is_small")
    title, always = "memory and time of a backward pass", ("scene", "backend", "horizon")
    cells = shown.cells(own, title, [CELLS_NOTE], always, tried, terminal=False)
    has_result = (tried["status"] == "ok") & tried["memory_mb"].notna()
    if not has_result.any():
        return Views([cells])
    # the first method is the experiment's first, in whatever order rows were stored
    places = {cell.key: place for place, cell in enumerate(grid.cells(experiment))}
    tried = tried.iloc[tried["key"].map(places).fillna(len(places)).to_numpy().argsort(kind="stable")]
    first, good = str(tried["method"].iloc[0]), tried[has_result]
    lines = longest(good, first)
    table = Table("backward_memory_methods", lines, LINES, "Memory and time of a backward pass", [NOTE], terminal=True, page=True)  # fmt: skip
    return Views([table, cells], _charts(shown, good))


def with_error(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows whose intervals of memory contain the error of the measurement, and which memories are only limits.

    A limit is the upper end of its interval, at least :data:`SMALL`.
    """
    memory, is_small = rows["memory_mb"], rows["memory_mb"] < SMALL
    low, high = (rows["memory_mb_low"] - FLOOR).clip(lower=0.0), rows["memory_mb_high"] + FLOOR
    limit = high.clip(lower=SMALL)
    return rows.assign(
        memory_mb=memory.mask(is_small, limit), memory_mb_low=low.mask(is_small, 0.0),
        memory_mb_high=high.mask(is_small, limit), is_small=is_small,
    )  # fmt: skip


def longest(good: pd.DataFrame, first: str) -> pd.DataFrame:
    """Return a line per problem and method at the problem's longest horizon, with ratios to the method ``first``."""
    keys, most = ["problem", "method"], good.groupby("problem")["horizon"].transform("max")
    last = good[good["horizon"] == most].drop_duplicates(keys, keep="last")
    last = pd.concat([part for _, part in last.groupby("problem", sort=False)]).set_index(keys, drop=False)
    is_first = last["method"] == first
    base = last[is_first].set_index("problem").reindex(last["problem"]).set_index(last.index).mask(is_first)
    before = good[good["horizon"] < most].sort_values("horizon").drop_duplicates(keys, keep="last")
    before = before.set_index(keys).reindex(last.index)
    order = np.log(ratio(last, before, "memory_mb")).div(np.log(last["horizon"] / before["horizon"]), axis=0)
    ratios = {"less": ratio(base, last, "memory_mb"), "longer": ratio(last, base, "gradient_s"), "order": order}
    kept = [f"{name}{end}" for name in ("memory_mb", "gradient_s") for end in ENDS]
    parts = [
        last[["problem", "method", "horizon", "is_small", *kept]],
        *(ratios[name].add_prefix(name) for name in ratios),
    ]
    return pd.concat(parts, axis=1).reset_index(drop=True)


def ratio(a: pd.DataFrame, b: pd.DataFrame, name: str) -> pd.DataFrame:
    """Return the ratio of a column of aligned rows with its ends; missing where a memory is only an upper limit.

    The interval divides the ends of both intervals, so it covers at least as often as both of them together.
    """
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
    return [
        Chart(name, good, [horizon], [y], series="method", panel="problem", across=2,
              subtitle=f"Batches of {samples} rollouts on one thread, a process per point",
              text=f"Median and range of the measured calls. A hollow marker is an upper limit: little is known below {SMALL:.0f} MiB.")
        for name, y in drawn.items()
    ]  # fmt: skip
