"""The charts of the main study: errors along each axis, error against cost, and estimators by problem."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis
from bench.experiment.columns import Column, text
from bench.experiment.views import Chart, Mark
from bench.model import SURROGATE, registry
from bench.report.colours import method_styles
from bench.report.problems import ProblemRows, split_by_problem
from bench.report.text import counted, number
from bench.report.views import (
    Arranged,
    attempted,
    estimator_curves,
    estimator_labels,
    pareto,
    shown_rmse,
)

from .columns import COLUMNS
from .comparisons import FAILS, NO_RESULT
from .time_to_accuracy import ROLLOUTS, SAMPLES, TARGETS, TIME, with_known

FLOOR = 1e-4
"""Relative biases below this are drawn here, as upper limits."""
SERIES = 3
"""Most estimators of a chart along an axis."""
PANELS = 4
"""Most problems of a chart along an axis."""
FEW = 3
"""Most points of an estimator that no line of error against cost joins."""
DISTINCT = 1.2
"""Median factor between the errors of two estimators from which a reader distinguishes their lines."""
RMSE = Column(
    "rmse_rel", label="relative RMSE of one estimate", low="rmse_low", high="rmse_high", limit="rmse_limit", log=True,
    above_one="worse than the zero estimate",
)  # fmt: skip
BIAS = Column(
    "bias_shown", label="relative bias", low="bias_from", high="bias_to", limit="bias_limit", log=True,
    above_one="larger than the gradient",
)  # fmt: skip
SECONDS = replace(COLUMNS.by_name["time_s"], label="time of one estimate", log=True)
ROLLOUTS_SPENT = Column(ROLLOUTS, label="rollouts of one estimate, a gradient at its measured cost", log=True)
FASTEST = "each estimator on its fastest backend"
ESTIMATOR = text("series", label="")


def charts(
    shown: Arranged,
    methods: pd.DataFrame,
    comparisons: pd.DataFrame,
    best: pd.DataFrame,
) -> list[Chart]:
    """Return all charts, the main one first."""
    labelled = replace(shown, rows=with_plotted_columns(shown.rows))
    subtitle = _conditions(shown)
    swept = shown.swept()
    order = sorted(swept, key=lambda a: (-swept[a], a.column != "stiffness"))
    along = [
        _along(labelled, axis, methods, comparisons, subtitle)
        for i, axis in enumerate(order)
        if not any(axis.column in other.moves for other in order[:i])  # axes that step together have one chart
        if axis.column != "samples" or best.empty
    ]
    if not best.empty:
        along = [_error_and_cost(labelled, best, subtitle), *along]
    elif shown.rows["backend"].nunique() > 1:
        along += [_error_and_cost(labelled, best, subtitle)]
    if not swept and methods["problem"].nunique() > 1:
        along = [_estimators(methods), *along]
    styles = method_styles(labelled.rows["series"].unique())
    return [replace(chart, styles=styles) for chart in along if chart is not None]


# ------------------------------------------------------------------------------------------------------- frames


def with_plotted_columns(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the columns that charts draw: errors in units of |grad J|, and labels of points and lines."""
    norm = rows["reference_norm"].where(rows["reference_norm"] > 0)
    limit = ~(rows["bias_low"] > 0)
    error, low, high, is_limit = shown_rmse(rows)
    values = {
        "rmse_rel": pd.Series(error, rows.index),
        "rmse_low": pd.Series(low, rows.index),
        "rmse_high": pd.Series(high, rows.index),
        "bias_shown": (rows["bias"].where(~limit, rows["bias_high"]) / norm).clip(lower=FLOOR),
        "bias_from": (rows["bias_low"] / norm).clip(lower=FLOOR),
        "bias_to": rows["bias_high"] / norm,
        ROLLOUTS: rows[ROLLOUTS],
    }
    good = rows["status"] == "ok"
    return rows.assign(
        **{name: column.where(good) for name, column in values.items()},
        rmse_limit=is_limit,
        bias_limit=limit,
        series=estimator_labels(rows),
        line=rows["backend"] + " " + rows["dtype"],
        failed=~good,
    )


def _conditions(shown: Arranged) -> str:
    """Return what all panels share: samples, medians over seeds, surrogate gradients."""
    rows = shown.rows
    parts = [str(rows["scene"].iloc[0])] if rows["scene"].nunique() == 1 else []
    parts += [f"{n:g} samples" for n in rows["samples"].unique()] if rows["samples"].nunique() == 1 else []
    seeds = rows["seed"].nunique()
    parts += [f"medians over {seeds} seeds"] if seeds > 1 else []
    for law in rows.loc[rows["reason"].str.contains(SURROGATE, regex=False), "contact"].unique():
        parts.append(f"{law}: {SURROGATE}")
    return ", ".join(parts)


# ---------------------------------------------------------------------------------------------- along an axis


def _along(
    shown: Arranged,
    axis: Axis,
    methods: pd.DataFrame,
    comparisons: pd.DataFrame,
    subtitle: str,
) -> Chart | None:
    """Return the chart of errors along an axis, of the main estimators on the main problems."""
    problems = [p for p in split_by_problem(shown, axis) if attempted(p.rows)["x"].nunique() > 1]
    if not problems:
        return None
    frame = pd.concat([_lines(problem) for problem in problems], ignore_index=True)
    drawn, notes = choose_problems(problems)
    names = _main_series(frame, methods, comparisons)
    total = frame["series"].nunique()
    panels = [problem.title() for problem in drawn]
    shares = [f"{len(names)} of {total} estimators"] if len(names) < total else []
    for column, kept in (("series", names), ("panel", panels)):
        frame = frame[frame[column].isin(kept)]
        frame = frame.iloc[frame[column].map(kept.index).argsort(kind="stable")]
    marks = [Mark(f"beyond the {name}", value, math.inf) for name, value in shown.marks(axis).items()]
    x = Column("x", label=axis.title, format="setting")
    return Chart(
        "bias_variance_" + re.sub(r"\W", "_", axis.column), frame, [x], [RMSE, BIAS], series="series",
        panel="panel", marks=marks, failed="failed", across=len(drawn),
        height=2.7 if len(drawn) <= 2 else 2.1,
        subtitle=", ".join(filter(None, [subtitle, *notes, *shares])),
        text="Bars are 95% intervals. A hollow marker is an upper limit.",
    )  # fmt: skip


def _lines(problem: ProblemRows) -> pd.DataFrame:
    """Return the points of a problem: of each estimator the first of the backends that agree."""
    curves = estimator_curves(problem.rows, 0.03)
    return curves[curves["curve"] == curves.groupby("label")["curve"].transform("min")].assign(panel=problem.title())


def _main_series(frame: pd.DataFrame, methods: pd.DataFrame, comparisons: pd.DataFrame) -> list[str]:
    """Return the estimators to print: those that are most often first, then others, as far as distinct."""
    estimator = dict(zip(methods["method"], methods["estimator"], strict=True))
    wins = Counter(estimator[name] for name in comparisons["first"] if name)
    names = sorted(frame["series"].unique(), key=lambda name: (-wins[name], "[" in name))
    errors = frame.pivot_table("rmse_rel", ["panel", "x"], "series", aggfunc="first").reindex(columns=names)
    errors = np.log(errors.where(errors > 0))
    chosen: list[str] = []
    for name in names:
        apart = errors[chosen].sub(errors[name], axis=0).abs().median()
        if len(chosen) < SERIES and not (apart < math.log(DISTINCT)).any():
            chosen.append(name)
    return chosen


def choose_problems(problems: Sequence[ProblemRows]) -> tuple[list[ProblemRows], list[str]]:
    """Return the problems to print, at most :data:`PANELS`, and notes on the problems omitted.

    Of problems that differ only in numbers, the first stands for all.
    """
    if len(problems) <= 2:
        return list(problems), []
    first: dict[str, ProblemRows] = {}
    for problem in problems:
        first.setdefault(", ".join(str(v) for v in problem.identity.values() if isinstance(v, str)), problem)
    chosen = list(first.values())[:PANELS]
    if len(chosen) == len(problems):
        return chosen, []
    numbers = {k: v for p in chosen for k, v in p.identity.items() if not isinstance(v, str)}
    held = ", ".join(f"{name} = {value:g}" for name, value in numbers.items())
    shares = f"{len(chosen)} of {counted(len(problems), 'problem')}"
    return chosen, [f"{shares} ({held})" if held else shares]


# ----------------------------------------------------------------------------------------------- error and cost


def _error_and_cost(shown: Arranged, best: pd.DataFrame, subtitle: str) -> Chart | None:
    """Return error against cost: where samples were swept the front of each estimator, per problem, else a point each."""
    is_swept, parts = not best.empty, []
    timed = not is_swept or bool((best["by"] == "time").any())
    cost, x = (TIME, SECONDS) if timed else (ROLLOUTS, ROLLOUTS_SPENT)
    axis, always = (SAMPLES, ("scene",)) if is_swept else (None, ("scene", "contact"))
    problems = split_by_problem(shown, axis, always)
    chosen = problems if is_swept else problems[:: math.ceil(len(problems) / 3)]
    for problem in chosen:
        rows = with_known(problem.rows, cost)
        for _, every in rows.groupby("series", sort=False) if not is_swept or rows["x"].nunique() > 1 else ():
            part = _on_fastest(every, cost)
            parts.append(part[pareto(part[cost], part["rmse_rel"])].assign(panel=problem.title()))
    if not parts:
        return None
    frame = pd.concat(parts, ignore_index=True)
    is_line = frame.groupby(["panel", "series"]).size().max() > FEW
    shares = [f"{len(chosen)} of {counted(len(problems), 'problem')}"] if len(chosen) < len(problems) else []
    marks = [Mark(f"{target:.0%}", target, axis="y") for target in TARGETS if is_swept]
    return Chart(
        "speed_accuracy" if timed else "rollouts_accuracy", frame, [x], [RMSE], "lines" if is_line else "points", series="series",
        panel="panel", marks=marks, across=3, height=2.0 if is_swept else 1.9, front=not is_swept,
        subtitle=", ".join(filter(None, [subtitle, *shares, FASTEST])),
        text="Only estimates that no other of the same estimator beats in both error and cost are drawn." if is_swept else "",
    )  # fmt: skip


def _on_fastest(rows: pd.DataFrame, cost: str) -> pd.DataFrame:
    """Return an estimator's rows on the backend with the lowest cost, by the median over the samples that all have."""
    lines = rows["line"]
    shared = rows[rows.groupby("x")["line"].transform("nunique") == lines.nunique()]
    rows_of = shared if len(shared) else rows
    return rows[lines == rows_of.groupby("line")[cost].median().idxmin()]


# --------------------------------------------------------------------------------------------------- estimators


def _estimators(methods: pd.DataFrame) -> Chart:
    """Return the heat table of errors: estimators by their worst case, in families, against problems."""
    worst = methods["error"].where(methods["status"] == "ok", math.inf)
    names = worst.groupby(methods["estimator"], sort=False).max().sort_values(kind="stable").index
    families = {name: _family(name.partition("[")[0]) for name in names}
    order = sorted(names, key=lambda name: list(dict.fromkeys(families.values())).index(families[name]))
    frame = methods.iloc[methods["estimator"].map(order.index).argsort(kind="stable")]
    error, known = frame["error"], np.isfinite(frame["error"])
    marks = frame["status"].where(frame["verdict"] == NO_RESULT, "").mask(frame["verdict"] == FAILS, " fails")
    return Chart(
        "estimators",
        frame.assign(panel=frame["estimator"].map(families), series=frame["estimator"], shade=(np.log10(error.clip(1e-2, 1e2)) / 4 + 0.5).where(known),
                     cell=error.map(number).where(known, marks)),
        [text("problem", label="")], [ESTIMATOR], "grid", panel="panel", shade="shade",
        cell="cell", across=1, height=0.2,
        subtitle="relative RMSE of one estimate, sorted by the worst case; above 1 the zero estimate is better",
    )  # fmt: skip


def _family(estimator: str) -> str:
    """Return an estimator's family by what it needs: costs, gradients or both."""
    entry = registry.entries()["estimators"].get(estimator)
    needs = frozenset(getattr(entry and entry.plugin, "needs", frozenset()))
    if "grad" in needs:
        return "gradients and costs" if needs & {"value", "score"} else "gradients of the program"
    return "costs only"
