"""Prints the main table, condensed if it is long, and the findings from it."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.experiment.axes import Axis
from bench.experiment.experiment import Experiment
from bench.measure.statistics import UNEXPLAINED, is_unexplained
from bench.report.problems import ProblemRows
from bench.report.study_tables import open_console
from bench.report.text import axis_value, duration, number, one_line
from bench.report.views import (
    UNSTEADY,
    Curve,
    arrange,
    bias_text,
    estimator_curves,
    estimator_label,
    is_bias_resolved,
    relative,
    unsteady,
)
from bench.studies.bias_variance.costs import EQUAL_ROLLOUTS, EQUAL_TIME, with_errors_at_equal_cost
from bench.studies.bias_variance.findings import TIE, lowest, problems_by_axis, span, winners

GOALS = (0.3, 0.1, 0.03)
"""Relative RMSEs for which the fastest estimator and backend are named."""
COSTS = {"rollouts": EQUAL_ROLLOUTS, "time": EQUAL_TIME}
NEGLIGIBLE = 0.01
"""Relative bias up to which an estimator is never reported as mostly biased."""
WIDTH = 100
FULL_ROWS = 40
"""Most rows to print one by one; a longer table is condensed."""


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the question, the counts, the main table (condensed if long) and the findings."""
    console = open_console(experiment, rows, WIDTH)
    parts = problems_by_axis(arrange(experiment, with_errors_at_equal_cost(rows)))
    condensed = len(rows) > FULL_ROWS
    for axis, group in parts:
        if condensed and axis is not None:
            _show_pivot(console, group, axis)
        else:
            _show_rows(console, group, axis, merge=condensed)
    _show_legend(console, condensed=condensed and any(axis is not None for axis, _ in parts))
    _show_reasons(console, rows)
    console.print("\nIn short", style="bold")
    for axis, group in parts:
        _show_verdict(console, group, axis)


def _show_rows(console: Console, group: ProblemRows, axis: Axis | None, merge: bool) -> None:
    """Print a line per cell or, with ``merge``, a line for each estimator and group of agreeing backends."""
    table = _table(group.title())
    if axis is not None:
        table.add_column(axis.column, justify="right")
    for name in ("estimator", "backend"):
        table.add_column(name, overflow="fold")
    for name in ("rel. bias [95%]", "variance", "rel. RMSE", "cosine", "time"):
        table.add_column(name, justify="right")
    curves = estimator_curves(group.rows) if merge else estimator_curves(group.rows, close=None)
    best = lowest(curves)
    for x, line in ((x, line) for x in _values(curves) for line in curves if x in line.at):
        row = line.at[x]
        cells = [] if axis is None else [axis_value(x)]
        cells += [line.label, "\n".join(_backends(line))]
        if row["status"] != "ok":
            table.add_row(*cells, Text(row["status"], "red"), "-", "-", "-", "-")
            continue
        bias = bias_text(row, row["reference_norm"]) + _remark_mark(row)
        times = _times(line) if merge else [duration(row["time_s"]) + UNSTEADY * bool(unsteady(row))]
        table.add_row(
            *cells, bias, number(row["variance"]), _rmse(row, best.get(x, math.nan)), number(row["cosine"], 3),
            "\n".join(times),
        )  # fmt: skip
    console.print(table)


def _show_pivot(console: Console, group: ProblemRows, axis: Axis) -> None:
    """Print two lines (bias and RMSE) for each estimator and group of agreeing backends, a column per value of the axis."""
    curves = estimator_curves(group.rows)
    best = lowest(curves)
    values = _values(curves)
    room = max(1, (console.width - 44) // 8)
    for start in range(0, len(values), room):
        chunk = values[start : start + room]
        table = _table(f"{group.title()}   (columns: {axis.title})")
        width = min(60, max(34, console.width - 12 - 8 * len(chunk)))
        table.add_column("estimator, time", max_width=width, overflow="fold")
        table.add_column("", no_wrap=True)
        for name in (*map(axis_value, chunk), "fail"):
            table.add_column(name, justify="right", no_wrap=True)
        for line in curves:
            cells = [_cell(line.at.get(x), best.get(x, math.nan)) for x in chunk]
            table.add_row(Text(line.label, "bold"), "bias", *(c[0] for c in cells), str(line.failed or ""))
            table.add_row(_timed_backends(line, width), "rmse", *(c[1] for c in cells), "")
        console.print(table)


def _cell(row: dict[str, Any] | None, best: float) -> tuple[Text, Text]:
    """Format a cell's relative bias and RMSE; its status in place of the bias if it failed."""
    if row is None or row["status"] != "ok":
        return Text("" if row is None else row["status"][:6], "red"), Text()
    if is_bias_resolved(row):
        return Text(number(relative(row, "bias")) + _remark_mark(row), "yellow"), _rmse(row, best)
    high = relative(row, "bias_high")
    return Text((f"<{number(high)}" if high > 0 else "0") + _remark_mark(row), "dim"), _rmse(row, best)


def _table(title: str) -> Table:
    return Table(
        title=Text(f"\n{title}", style="bold"), title_justify="left", box=None, pad_edge=False, padding=(0, 2, 0, 0),
        header_style="underline",
    )  # fmt: skip


def _remark_mark(row: Any) -> str:
    return "?" if row["reason"] else ""


def _rmse(row: Any, best: float) -> Text:
    value = row["rmse_rel"]
    mark = "*" if value <= TIE * best else ""
    return Text(number(value) + mark, "bold green" if mark and value < 1 else "red" if value >= 1 else "")


def _backends(line: Curve) -> list[str]:
    return [("" if exact else "~") + name for name, exact in line.backends.items()]


def _times(line: Curve) -> list[str]:
    return [duration(seconds) + UNSTEADY * (name in line.noisy) for name, seconds in line.seconds.items()]


def _timed_backends(line: Curve, width: int) -> str:
    """Format the time of one estimate on each backend, ``jax 0.21ms, torch 12ms``, with line breaks between backends."""
    times = [time.replace(" ", "") for time in _times(line)]
    text = ", ".join(f"{name}\0{time}" for name, time in zip(_backends(line), times, strict=True))
    return textwrap.fill(text, width, initial_indent="  ", subsequent_indent="  ").replace("\0", " ")


def _values(curves: Sequence[Curve]) -> list[float]:
    return sorted({x for line in curves for x in line.at})


def _show_legend(console: Console, condensed: bool) -> None:
    bias = (
        "'<u' when it cannot be distinguished from 0 and lies below u"
        if condensed
        else "0 (< u) when it cannot be distinguished from 0"
    )
    console.print(
        f"\nbias: |mean - reference| / |grad J|, {bias} (95%). rmse: error of one estimate / |grad J|, above 1 worse than "
        "the zero estimate; * lowest from as many samples, within 10%. A ? is explained below. Backends on one line agree to 1e-6, with ~ to 1%. "
        f"A time marked {UNSTEADY} was unsteady: the interquartile range of its calls is over 20% of it."
        + (" Under each estimator: backends and their time per estimate. fail: cells not ok." if condensed else "")
    )


def _show_reasons(console: Console, rows: pd.DataFrame) -> None:
    """Print why rows failed or were refused, and their remarks; reasons that differ only in numbers are merged."""
    remarked = rows[rows["reason"] != ""]
    if remarked.empty:
        return
    console.print("\nFailed, refused or noted", style="bold")
    kinds = remarked["reason"].str.replace(r"\d+(\.\d+)?(e[+-]?\d+)?", "#", regex=True)
    for (status, _), part in sorted(remarked.groupby(["status", kinds]), key=lambda item: -len(item[1])):
        more = "" if part["reason"].nunique() == 1 else " (for example)"
        _print_wrapped(console, f"{len(part)} {status}: {one_line(part['reason'].iloc[0])}{more}", 2)


def _print_wrapped(console: Console, text: str, indent: int) -> None:
    lead = " " * indent
    console.print(textwrap.fill(text, console.width, initial_indent=lead, subsequent_indent=lead + "  "))


def _show_verdict(console: Console, group: ProblemRows, axis: Axis | None) -> None:
    """Print one problem's findings: the estimators of lowest error, the biased and the useless ones, with their ranges."""
    console.print(f"  {group.title()}" + (f", by {axis.title}" if axis else ""), style="bold")
    curves = estimator_curves(group.rows)
    ranked = {f"lowest error at equal {cost}": _winners(curves, error) for cost, error in COSTS.items()}
    for text, names in ranked.items():
        if names:
            _print_wrapped(console, f"{text}: {names}", 4)
    for text, test in (
        ("mostly bias, more samples do not help", _is_mostly_bias),
        (f"a bias where none is declared, {UNEXPLAINED}", _has_unexplained_bias),
        ("no better than the zero estimate", lambda row: bool(row["rmse_rel"] >= 1)),
    ):
        where: dict[str, dict[float, bool]] = {}
        for line in curves:
            holds_at = where.setdefault(line.label, {})
            for x, row in line.at.items():
                holds_at[x] = holds_at.get(x, False) or (row["status"] == "ok" and test(row))
        parts = [f"{label} {span(holds)}".strip() for label, holds in where.items() if any(holds.values())]
        if parts:
            _print_wrapped(console, f"{text}: {', '.join(parts)}", 4)
    if axis is not None and axis.column == "samples":
        firsts: dict[str, list[str]] = {}
        for goal in GOALS:
            firsts.setdefault(_first(group.rows, goal), []).append(f"{goal:g}")
        parts = [f"{', '.join(goals)}: {first}" for first, goals in firsts.items()]
        _print_wrapped(console, f"first to a relative RMSE of {'; '.join(parts)}", 4)


def _winners(curves: Sequence[Curve], error: str) -> str:
    """Format the estimators of lowest error and their ranges along the axis; empty where the cost is not known."""
    named = {x: ", ".join(labels) for x, labels in winners(curves, error).items()}
    ranges = {text: span({x: names == text for x, names in named.items()}) for text in named.values()}
    return "; ".join(f"{where}: {text}" if where else text for text, where in ranges.items())


def _is_mostly_bias(row: Any) -> bool:
    dominates = is_bias_resolved(row) and row["bias_rel"] > NEGLIGIBLE and row["bias"] ** 2 > row["rmse"] ** 2 / 2
    return bool(dominates and not _has_unexplained_bias(row))


def _has_unexplained_bias(row: Any) -> bool:
    return is_unexplained(row["reason"])


def _first(rows: pd.DataFrame, goal: float) -> str:
    """Format the fastest cell with a relative RMSE of at most ``goal``; ``none`` if no cell has it."""
    good = rows[(rows["status"] == "ok") & (rows["rmse_rel"] <= goal) & np.isfinite(rows["time_s"])]
    if good.empty:
        return "none"
    row = good.loc[good["time_s"].idxmin()]
    label = estimator_label(row["estimator"], row["estimator_params"])
    return f"{label} on {row['backend']} in {duration(row['time_s'])} with {row['x']:g} samples"
