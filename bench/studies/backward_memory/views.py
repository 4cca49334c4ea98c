"""What the study of backward passes shows: memory and time of gradients along the horizon, by method."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from bench.experiment import grid
from bench.experiment.columns import Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Table, Views
from bench.report.generic import engine_table
from bench.report.problems import axes_of, problem_names
from bench.report.style import colour, marker
from bench.report.text import listed, number
from bench.report.views import arrange
from bench.report.writer import reasons

FLOOR = 0.1
"""Smallest memory in MB that is drawn: the kernel counts resident pages of a thread only to within about this."""
AGREES = 1e-6
"""Relative difference up to which gradients agree: rounding, and central differences of costs in a pass over Jacobians."""
SHOWN = ("memory_mb", "gradient_s", "process_mb", "gradient_error_rel")
LINES = (
    text("problem"),
    text("method"),
    Column("memory_mb", unit="MB", label="memory", low="memory_mb_low", high="memory_mb_high"),
    Column("less", label="times less memory", low="less_low", high="less_high"),
    Column("gradient_s", label="gradients", low="gradient_s_low", high="gradient_s_high", format="seconds"),
    Column("longer", label="times the time", low="longer_low", high="longer_high"),
    Column("order", "p in memory ~ T^p", label="order of memory", low="order_low", high="order_high"),
)
"""The columns of the table with a line per problem and method."""
NOTE = (
    "At the longest horizon of each problem. Memory is the peak of a batch of gradients beyond the memory of the process before. "
    "Ratios are to the first method. order: p in memory ~ T^p between the two longest horizons. Intervals are ranges of "
    "the measured calls, which contain a median with probability 97% or more, and ratios of their ends."
)
CELLS_NOTE = (
    "One process per cell. Memory is the peak of a batch of gradients beyond `process`, the memory before. Difference: the "
    "relative distance of the mean gradient from that of the first backend that computes references."
)


class Ratio(NamedTuple):
    """A ratio of two positive numbers with its interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{number(self.value)} [{number(self.low)}, {number(self.high)}]"


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the findings, the tables of the longest horizon and of all cells, and the charts of memory and time."""
    shown = arrange(experiment, rows)
    own = [replace(experiment.columns.by_name[name], digits=3) for name in SHOWN]
    cells = engine_table(
        experiment, rows, shown, own, "memory and time of a backward pass", [CELLS_NOTE], always=("scene", "backend", "horizon")
    )  # fmt: skip
    cells = replace(cells, terminal=False)
    good = shown.rows[(shown.rows["status"] == "ok") & shown.rows["memory_mb"].notna()]
    if good.empty:
        return Views(["No cell gave a result: the table has the reason of each."], [cells], remarks=reasons(rows))
    # the first method is the experiment's first, in whatever order rows were stored
    places = {cell.key: place for place, cell in enumerate(grid.cells(experiment))}
    good = good.iloc[good["key"].map(places).fillna(len(places)).to_numpy().argsort(kind="stable")]
    over = axes_of(shown, "horizon")
    good = good.assign(
        problem=problem_names(shown, ["scene", "contact", "integrator"], over, always=["scene"], rows=good),
        method=problem_names(shown, ["backend"], over, always=["backend"], rows=good),
    )
    lines = longest(good)
    table = Table("backward_memory_methods", lines, LINES, "Memory and time of a backward pass", [NOTE], terminal=True, page=True)  # fmt: skip
    charts = _charts(experiment, good, lines)
    return Views(findings(good, lines), [table, cells], charts, remarks=reasons(rows))


def longest(good: pd.DataFrame) -> pd.DataFrame:
    """Return a line per problem and method at the problem's longest horizon, with ratios to the first method."""
    entries: list[dict[str, Any]] = []
    for _, part in good.groupby("problem", sort=False):
        horizon = part["horizon"].max()
        last = part[part["horizon"] == horizon].drop_duplicates("method", keep="last")
        before = part[part["horizon"] < horizon]
        first = last.iloc[0]
        for _, row in last.iterrows():
            less, longer = ratio(first, row, "memory_mb"), ratio(row, first, "gradient_s")
            earlier = before[before["method"] == row["method"]].sort_values("horizon").tail(1)
            order = _order(earlier.iloc[0], row) if len(earlier) else Ratio(*[math.nan] * 3)
            names = ("problem", "method", "horizon", *(f"{n}{e}" for n in ("memory_mb", "gradient_s") for e in ("", "_low", "_high")))  # fmt: skip
            entries.append({name: row[name] for name in names} | {
                f"{name}{end}": value
                for name, one in (("less", less), ("longer", longer), ("order", order))
                for end, value in zip(("", "_low", "_high"), one, strict=True)
            })  # fmt: skip
    return pd.DataFrame(entries)


def ratio(a: pd.Series, b: pd.Series, name: str) -> Ratio:
    """Return the ratio of a column of two rows. Memory below :data:`FLOOR` counts as the floor.

    The interval divides the ends of both intervals, so it covers at least as often as both of them together.
    """
    floor = FLOOR if name == "memory_mb" else 0.0
    above, below = ([max(float(row[f"{name}{end}"]), floor) for end in ("", "_low", "_high")] for row in (a, b))
    return Ratio(above[0] / below[0], above[1] / below[2], above[2] / below[1])


def _order(earlier: pd.Series, later: pd.Series) -> Ratio:
    """Return p in memory ~ T^p between two horizons; NaN where a memory is below the floor."""
    if min(earlier["memory_mb_low"], later["memory_mb_low"]) < FLOOR:
        return Ratio(*[math.nan] * 3)
    steps = math.log(later["horizon"] / earlier["horizon"])
    return Ratio(*(math.log(value) / steps for value in ratio(later, earlier, "memory_mb")))


def findings(good: pd.DataFrame, lines: pd.DataFrame) -> list[str]:
    """Return the method with the least memory at the longest horizon, the fastest one, and whether gradients agree."""
    parts = []
    for problem, part in lines.groupby("problem", sort=False):
        least = part.loc[part["memory_mb"].idxmin()]
        less, longer = (Ratio(*(least[f"{name}{end}"] for end in ("", "_low", "_high"))) for name in ("less", "longer"))
        parts.append(
            f"on {problem} {least['method']} needs {less} times less memory than {part.iloc[0]['method']} at {longer} times its time"
        )
    first = f"At T = {int(lines['horizon'].max()):,}, {listed(parts)}."
    return [first, fastest(lines), agreement(good)]


def fastest(lines: pd.DataFrame) -> str:
    """Return the fastest method of each problem at the longest horizon, or the methods whose intervals overlap."""
    names: dict[str, list[str]] = {}
    for problem, part in lines.groupby("problem", sort=False):
        limit = part.loc[part["gradient_s"].idxmin(), "gradient_s_high"]
        close = part[part["gradient_s_low"] <= limit]["method"]
        names.setdefault(" or ".join(close) + (" (open)" if len(close) > 1 else ""), []).append(str(problem))
    return f"The fastest there is {', '.join(f'{name} on {listed(problems)}' for name, problems in names.items())}."


def agreement(good: pd.DataFrame) -> str:
    """Return in how many cells the gradient agrees with that of the backend it is compared with, and the largest difference."""
    known = good[good["gradient_error_rel"].notna()]
    if known.empty:
        return "No gradient was compared with another one."
    same = int((known["gradient_error_rel"] <= AGREES).sum())
    worst = known.loc[known["gradient_error_rel"].idxmax()]
    return (
        f"{'All' if same == len(known) else f'{same} of'} {len(known)} gradients agree with {listed(known['compared_with'].unique())} "
        f"within {number(AGREES, 1)}, and the largest relative difference is {number(worst['gradient_error_rel'])} "
        f"({worst['method']}, {worst['problem']}, T = {int(worst['horizon']):,})."
    )


def _charts(experiment: Experiment, good: pd.DataFrame, lines: pd.DataFrame) -> list[Chart]:
    """Return the charts of memory and of time along the horizon, a panel per problem and a line per method."""
    own = experiment.columns.by_name
    names = [f"memory_mb{end}" for end in ("", "_low", "_high")]
    frame = good.assign(
        row=good.index, is_small=good["memory_mb"] < FLOOR, **{n: good[n].clip(lower=FLOOR) for n in names}
    )
    methods = list(dict.fromkeys(good["method"]))
    styles = {method: Style(colour(i), marker(i)) for i, method in enumerate(methods)}
    horizon = replace(own["horizon"], label="horizon T", log=True)
    memory = replace(own["memory_mb"], limit="is_small", log=True)
    seconds = replace(own["gradient_s"], label="time of a batch of gradients", log=True)
    samples = " or ".join(f"{count:g}" for count in good["samples"].unique())
    least = lines.loc[lines["less"].idxmax()] if np.isfinite(lines["less"]).any() else lines.iloc[0]
    quick = lines.loc[lines["longer"].idxmin()]
    first = lines.iloc[0]["method"]
    shared: dict[str, Any] = dict(
        series="method", panel="problem", styles=styles, across=2,
        subtitle=f"Batches of {samples} rollouts on one thread, a process per point",
    )  # fmt: skip
    return [
        Chart(
            "backward_memory", f"{least['method']} needs up to {number(least['less'])} times less memory than {first}", frame,
            [horizon], [memory], text="Peak of the resident memory beyond the memory before the gradients. An arrow: at most so much.", **shared,
        ),
        Chart(
            "backward_time", f"{quick['method']} is up to {number(1.0 / quick['longer'])} times as fast as {first}", frame,
            [horizon], [seconds], text="Median and range of the measured calls.", **shared,
        ),
    ]  # fmt: skip
