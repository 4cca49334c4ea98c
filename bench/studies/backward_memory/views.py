"""What the study of backward passes shows: memory and time of gradients along the horizon, by method."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import pandas as pd

from bench.experiment import grid
from bench.experiment.columns import Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Table, Views
from bench.report.shown import Shown
from bench.report.style import colour, marker
from bench.report.writer import reasons

FLOOR = 0.3
"""Error of a measured memory in MiB: the kernel counts resident pages late, so that peaks are 0.1 to 0.25 MiB too low."""
SMALL = 1.0
"""Memory in MiB, about three floors, below which a memory is an upper limit without ratios and orders."""
SHOWN = ("memory_mb", "gradient_s", "process_mb", "gradient_error_rel")
LINES = (
    text("problem"),
    text("method"),
    Column("memory_mb", unit="MiB", label="memory", low="memory_mb_low", high="memory_mb_high", limit="is_small"),
    Column("less", label="times less memory", low="less_low", high="less_high"),
    Column("gradient_s", label="gradients", low="gradient_s_low", high="gradient_s_high", format="seconds"),
    Column("longer", label="times the time", low="longer_low", high="longer_high"),
    Column("order", "p in memory ~ T^p", label="order of memory", low="order_low", high="order_high"),
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


class Ratio(NamedTuple):
    """A ratio of two positive numbers with its interval, NaN where it is not known."""

    value: float
    low: float
    high: float


UNKNOWN = Ratio(math.nan, math.nan, math.nan)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the tables of the longest horizon and of all cells, and the charts of memory and time."""
    shown = Shown(experiment, rows, along=["horizon"])
    tried = with_error(shown.rows)
    own = [shown.column(name, digits=3) for name in SHOWN]
    own[0] = replace(own[0], limit="is_small")
    title, always = "memory and time of a backward pass", ("scene", "backend", "horizon")
    cells = shown.cells(own, title, [CELLS_NOTE], always, tried, terminal=False)
    if not _has_result(tried).any():
        return Views([cells], remarks=reasons(rows))
    # the first method is the experiment's first, in whatever order rows were stored
    places = {cell.key: place for place, cell in enumerate(grid.cells(experiment))}
    tried = tried.iloc[tried["key"].map(places).fillna(len(places)).to_numpy().argsort(kind="stable")]
    first, good = str(tried["method"].iloc[0]), tried[_has_result(tried)]
    lines = longest(good, first)
    table = Table("backward_memory_methods", lines, LINES, "Memory and time of a backward pass", [NOTE], terminal=True, page=True)  # fmt: skip
    return Views([table, cells], _charts(experiment, good), remarks=reasons(rows))


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


def _has_result(rows: pd.DataFrame) -> pd.Series:
    return (rows["status"] == "ok") & rows["memory_mb"].notna()


def longest(good: pd.DataFrame, first: str) -> pd.DataFrame:
    """Return a line per problem and method at the problem's longest horizon, with ratios to the method ``first``."""
    entries: list[dict[str, Any]] = []
    for _, part in good.groupby("problem", sort=False):
        horizon = part["horizon"].max()
        last = part[part["horizon"] == horizon].drop_duplicates("method", keep="last")
        before = part[part["horizon"] < horizon]
        base = last[last["method"] == first]
        for _, row in last.iterrows():
            less = longer = UNKNOWN
            if len(base) and row["method"] != first:
                less, longer = ratio(base.iloc[0], row, "memory_mb"), ratio(row, base.iloc[0], "gradient_s")
            earlier = before[before["method"] == row["method"]].sort_values("horizon").tail(1)
            order = _order(earlier.iloc[0], row) if len(earlier) else UNKNOWN
            names = ("problem", "method", "horizon", "is_small", *(f"{n}{e}" for n in ("memory_mb", "gradient_s") for e in ("", "_low", "_high")))  # fmt: skip
            entries.append({name: row[name] for name in names} | {
                f"{name}{end}": value
                for name, one in (("less", less), ("longer", longer), ("order", order))
                for end, value in zip(("", "_low", "_high"), one, strict=True)
            })  # fmt: skip
    return pd.DataFrame(entries)


def ratio(a: pd.Series, b: pd.Series, name: str) -> Ratio:
    """Return the ratio of a column of two rows; unknown where a memory is only an upper limit.

    The interval divides the ends of both intervals, so it covers at least as often as both of them together.
    """
    if name == "memory_mb" and (a["is_small"] or b["is_small"]):
        return UNKNOWN
    above, below = ([float(row[f"{name}{end}"]) for end in ("", "_low", "_high")] for row in (a, b))
    return Ratio(above[0] / below[0], above[1] / below[2], above[2] / below[1])


def _order(earlier: pd.Series, later: pd.Series) -> Ratio:
    """Return p in memory ~ T^p between two horizons; unknown where a memory is only an upper limit."""
    steps = math.log(later["horizon"] / earlier["horizon"])
    return Ratio(*(math.log(value) / steps for value in ratio(later, earlier, "memory_mb")))


def _charts(experiment: Experiment, good: pd.DataFrame) -> list[Chart]:
    """Return the charts of memory and of time along the horizon, a panel per problem and a line per method."""
    own = experiment.columns.by_name
    methods = dict.fromkeys(good["method"])
    styles = {method: Style(colour(i), marker(i)) for i, method in enumerate(methods)}
    horizon = replace(own["horizon"], label="horizon T", log=True)
    memory = replace(own["memory_mb"], limit="is_small", log=True)
    seconds = replace(own["gradient_s"], label="time of a batch of gradients", log=True)
    samples = " or ".join(f"{count:g}" for count in good["samples"].unique())
    conditions = f"Batches of {samples} rollouts on one thread, a process per point"
    limits = f". Hollow: at most so much, since little is known below {SMALL:.0f} MiB" if good["is_small"].any() else ""
    shared: dict[str, Any] = dict(
        series="method", panel="problem", styles=styles, across=2,
    )  # fmt: skip
    return [
        Chart(
            "backward_memory", good, [horizon], [memory],
            text="Peak of the resident memory beyond the memory before the gradients.", subtitle=conditions + limits, **shared,
        ),
        Chart(
            "backward_time", good, [horizon], [seconds],
            text="Median and range of the measured calls.", subtitle=conditions, **shared,
        ),
    ]  # fmt: skip
