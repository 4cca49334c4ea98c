"""The charts of the main study: errors along each axis, error against cost, and estimators by problem."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from bench.errors import unknown
from bench.experiment.axes import Axis
from bench.experiment.columns import Column, interval, text
from bench.experiment.parameters import PROBLEM
from bench.experiment.views import Chart, Mark, Style
from bench.model import SURROGATE, registry
from bench.report.colours import graded, method_styles
from bench.report.problems import ProblemRows, problem_numbers, split_by_problem
from bench.report.style import MARKERS, colour
from bench.report.text import axis_value, counted, number
from bench.report.views import (
    Arranged,
    attempted,
    estimator_curves,
    estimator_labels,
    shown_rmse,
)
from bench.report.writer import LEAST

from .columns import COLUMNS
from .comparisons import FAILS, NO_RESULT
from .time_to_accuracy import COSTS, ROLLOUTS, SAMPLES, TARGETS, TIME, with_known
from .time_to_accuracy import methods as methods_by_cost

FLOOR = 1e-4
"""Relative errors below this are drawn here, as upper limits."""
GRADES = {0.1: "#08519c", 0.3: "#6baed6", 1.0: "#d6e6f4", 10.0: "#fdae61", math.inf: "#c51b1b"}
"""Upper ends of the grades of an error, and their colours."""
PANELS = 4
"""Most problems of a chart along an axis."""
RMSE = Column(
    "rmse_rel", label="relative RMSE of one estimate", low="rmse_low", high="rmse_high", limit="rmse_limit", log=True, least=FLOOR,
    above_one="worse than the zero estimate",
)  # fmt: skip
BIAS = Column(
    "bias_shown", label="relative bias", low="bias_from", high="bias_to", limit="bias_limit", log=True, least=FLOOR,
    above_one="larger than the gradient",
)  # fmt: skip
COST = interval("cost", label="cost of a rollout", log=False)
SECONDS = replace(COLUMNS.by_name["time_s"], label="time of one estimate", log=True)
FASTEST = "each estimator on its fastest backend"
ESTIMATOR = text("series", label="")


def charts(
    shown: Arranged,
    methods: pd.DataFrame,
    best: pd.DataFrame,
) -> list[Chart]:
    """Return all charts, the main one first."""
    labelled = replace(shown, rows=with_plotted_columns(shown.rows))
    subtitle = _conditions(shown)
    swept = shown.swept()
    order = sorted(swept, key=lambda a: (-swept[a], a.column not in ("stiffness", "samples")))
    along = [
        _along(labelled, axis, subtitle)
        if axis.column != "samples" or best.empty
        else _cost_of_accuracy(shown, best, subtitle)
        for i, axis in enumerate(order)
        if not any(axis.column in other.moves for other in order[:i])  # axes that step together have one chart
    ]
    if shown.rows["time_s"].notna().any():
        along = [_contrast(labelled, subtitle), *along]
    if not swept and shown.rows["backend"].nunique() > 1:
        along += [_error_and_cost(labelled, subtitle)]
    is_grid = (methods[["setting", "estimator"]].nunique() > 1).all()
    if best.empty and max(swept.values(), default=0) < LEAST and is_grid:
        along = [_estimators(methods), *along]
    drawn = [chart for chart in along if chart is not None]
    names = [name for chart in drawn if chart.series for name in chart.frame[chart.series]]
    styles = method_styles(dict.fromkeys([*labelled.rows["series"], *names]))
    return [chart if chart.styles else replace(chart, styles=styles) for chart in drawn]


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
        "bias_shown": rows["bias"].where(~limit, rows["bias_high"]) / norm,
        "bias_from": rows["bias_low"] / norm,
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
    subtitle: str,
) -> Chart | None:
    """Return the chart of errors along an axis, of the main estimators on the main problems."""
    always = ("scene",) * (shown.rows["scene"].nunique() > 1)
    problems = [p for p in split_by_problem(shown, axis, always) if attempted(p.rows)["x"].nunique() > 1]
    if not problems:
        return None
    drawn, notes = choose_problems(problems)
    backends = shown.experiment.compares.get("backends", ())
    frame = pd.concat([_lines(problem, backends) for problem in problems], ignore_index=True)
    # most estimators of a chart along an axis, where the experiment does not name them
    names = shown.experiment.compares.get("estimators") or list(dict.fromkeys(frame["label"]))[:6]
    total = frame["label"].nunique()
    shares = [f"{len(names)} of {total} estimators"] if len(names) < total else []
    for column, kept in (("label", names), ("panel", [problem.title() for problem in drawn])):
        frame = frame[frame[column].isin(kept)]
        frame = frame.iloc[frame[column].map(kept.index).argsort(kind="stable")]
    if backends:
        frame = frame.assign(panel=frame["panel"] + ", " + frame["label"], series=frame["backend"])
    marks = [Mark(f"beyond the {name}", value, math.inf) for name, value in shown.marks(axis).items()]
    x = Column("x", label=axis.title, format="setting")
    return Chart(
        "bias_variance_" + re.sub(r"\W", "_", axis.column), frame, [x], [RMSE, BIAS], series="series",
        panel="panel", marks=marks, failed="failed", across=len(names) if backends else len(drawn),
        height=2.7 if len(drawn) <= 2 else 2.1, styles=_nested(backends),
        subtitle=", ".join(filter(None, [subtitle, *notes, *shares])),
        text="Bars are 95% intervals. A hollow marker is an upper limit.",
    )  # fmt: skip


def _lines(problem: ProblemRows, backends: Sequence[str]) -> pd.DataFrame:
    """Return the points of a problem: a line per estimator and backend, those that agree as one unless these are compared."""
    curves = estimator_curves(problem.rows, None if backends else 0.03)
    curves = curves[curves["backend"].isin(backends)] if backends else curves
    if not backends:  # those that differ from the first are named after their backends
        first = curves["curve"] == curves.groupby("label")["curve"].transform("min")
        curves = curves.assign(series=curves["label"].where(first, curves["method"]))
    return curves.assign(panel=problem.title())


def _nested(names: Sequence[str]) -> dict[str, Style]:
    """Return looks in which lines on top of each other are all seen: each later one is thinner."""
    count = len(names)
    return {name: Style(colour(i), MARKERS[i], width=1.2 * (count - i)) for i, name in enumerate(names)}


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


def _error_and_cost(shown: Arranged, subtitle: str) -> Chart | None:
    """Return error against time where nothing was swept: a point per estimator on its fastest backend, a panel per problem."""
    parts = []
    for problem in split_by_problem(shown, None, ("scene", "contact")):
        rows = with_known(problem.rows, TIME)
        parts += [_on_fastest(every).assign(panel=problem.title()) for _, every in rows.groupby("series", sort=False)]
    if not parts:
        return None
    return Chart(
        "speed_accuracy", pd.concat(parts, ignore_index=True), [SECONDS], [RMSE], "points", series="series",
        panel="panel", line="line", arrow="series", across=3, height=1.9, subtitle=", ".join(filter(None, [subtitle, FASTEST])),
    )  # fmt: skip


def _contrast(shown: Arranged, subtitle: str) -> Chart | None:
    """Return error against time at two values of an axis, joined by arrows, as the experiment's ``compares`` names them."""
    program = problem_numbers(shown.rows, PROBLEM)
    # cells of one program have the same costs, and those that use costs store them
    cost = shown.rows[[COST.name, COST.low, COST.high]].groupby(program).transform("first")
    rows = with_known(shown.rows.assign(**cost), TIME)
    joined_axis: tuple[Axis, Sequence[Any]] | None = None
    for name, values in shown.experiment.compares.items():
        axis = next((axis for axis in shown.axes if name in (axis.column, axis.short)), None)
        column = (
            "series" if name == "estimators" else "backend" if name == "backends" else axis.column if axis else name
        )
        if column not in rows:
            raise unknown("axis in compares", name, (*shown.numbers, "estimators", "backends"))
        rows = rows[rows[column].isin(values)]
        joined_axis = (axis, values) if len(values) == 2 and axis else joined_axis
    if joined_axis is None or rows.empty:
        return None
    along, (start, end) = joined_axis
    parts = [_on_fastest(part) for _, part in rows.groupby(["series", "contact"], sort=False)]
    frame = pd.concat(parts).sort_values(along.column, key=lambda at: at == end, kind="stable")
    # one program at both settings: what differs is noise
    frame[TIME] = frame.groupby(["series", "contact"])[TIME].transform("median")
    frame = frame.assign(arrow=frame["series"] + ", " + frame["contact"], line=frame["contact"].str.partition("[")[0])
    return Chart(
        "contrast", frame, [SECONDS], [RMSE, *[COST] * bool(frame["cost"].notna().any())], "points", series="series", line="line",
        arrow="arrow", height=2.9, own_scales=True,
        subtitle=", ".join(filter(None, [subtitle, f"arrows: {along.title} {axis_value(start)} to {axis_value(end)}", FASTEST])),
        text="An arrow joins the same estimator at two settings. Below are the costs of the same rollouts at both, with bars for 95% of them.",
    )  # fmt: skip


def _on_fastest(rows: pd.DataFrame) -> pd.DataFrame:
    """Return an estimator's rows on its fastest backend, by the median over its settings."""
    return rows[rows["line"] == rows.groupby("line")[TIME].median().idxmin()]


def _cost_of_accuracy(shown: Arranged, best: pd.DataFrame, subtitle: str) -> Chart:
    """Return the cost of each estimator to reach an error: a row per problem, with who is first and by what factor.

    Where backends are compared, each problem has a panel with a row per backend.
    """
    kind, target = best["by"].iloc[0], TARGETS[0]
    backends = shown.experiment.compares.get("backends", ()) if kind == "time" else ()
    lead = best[(best["by"] == kind) & (best["relative error"] == target)].set_index("problem", drop=False)
    lines = []
    for problem in split_by_problem(shown, SAMPLES, ("scene",)):
        found = methods_by_cost(problem, target, COSTS[kind]) if problem.title() in lead.index else {}
        for name, needed in found.items():
            estimator, _, backend = name.partition(" on ")
            low, high = (needed.cost * math.exp(sign * size) for sign, size in ((-1, needed.down), (1, needed.up)))
            lines.append({"problem": _with_lead(lead.loc[problem.title()]), "series": estimator, "cost": needed.cost, "low": low, "high": high, "limit": needed.how == "at once",
                          "lost": not math.isfinite(needed.cost), "backend": backend})  # fmt: skip
    frame = pd.DataFrame(lines)
    frame = frame.sort_values("cost").drop_duplicates(["problem", "series", *["backend"] * bool(backends)]).sort_index()
    frame = frame[frame["backend"].isin(backends or frame["backend"])]
    label = f"{'time' if kind == 'time' else 'rollouts'} to a relative error of {target:.0%}"
    cost = Column(
        "cost",
        label=label,
        format="seconds" if kind == "time" else "setting",
        low="low",
        high="high",
        limit="limit",
        log=True,
    )
    return Chart(
        "speed_accuracy" if kind == "time" else "rollouts_accuracy", frame, [cost], [text("backend" if backends else "problem", label="")],
        "dots", series="series", panel="problem" if backends else "", failed="lost", across=3, height=0.25,
        subtitle=", ".join(filter(None, [subtitle, "" if backends else FASTEST, "crosses: not known to be reached"])),
    )  # fmt: skip


def _with_lead(best: Any) -> str:
    """Return a problem with the first method there, and the factor by which it leads."""
    if best["fastest"] == "-":
        return f"{best['problem']}\nnone"
    others = (
        f"{number(best['factor'])}x ahead"
        if best["factor_low"] > 1 and best["factor"] > 0
        else f"at least {number(best['factor_low'])}x ahead"
        if best["factor_low"] > 1
        else "tied"
    )
    return f"{best['problem']}\n{best['fastest']}, {others}"


# --------------------------------------------------------------------------------------------------- estimators


def _estimators(methods: pd.DataFrame) -> Chart:
    """Return the heat table of errors: estimators by their worst case, in families, against problems."""
    worst = methods["error"].where(methods["status"] == "ok", math.inf)
    names = worst.groupby(methods["estimator"], sort=False).max().sort_values(kind="stable").index
    families = {name: _family(name.partition("[")[0]) for name in names}
    order = sorted(names, key=lambda name: list(dict.fromkeys(families.values())).index(families[name]))
    frame = methods.iloc[methods["estimator"].map(order.index).argsort(kind="stable")]
    at = ", " + frame["axis"] + "=" + frame["at"].map(axis_value)
    error, known = frame["error"], np.isfinite(frame["error"])
    marks = frame["status"].where(frame["verdict"] == NO_RESULT, "").mask(frame["verdict"] == FAILS, " fails")
    grades, looks = graded(error, GRADES, "{:g}".format)
    return Chart(
        "estimators",
        frame.assign(panel=frame["estimator"].map(families), series=frame["estimator"], grade=grades.where(known, "no result"), problem=frame["problem"] + at.where(frame["axis"] != "", ""),
                     cell=(pd.Series(np.where(frame["error_is_limit"], "<", ""), frame.index) + error.map(number)).where(known, marks)),
        [text("problem", label="")], [ESTIMATOR], "grid", panel="panel", level="grade", styles=looks | {"no result": Style("#f2f2f2")},
        cell="cell", across=1, height=0.2,
        subtitle="relative RMSE of one estimate, sorted by the worst case; from 1 on the zero estimate is better",
    )  # fmt: skip


def _family(estimator: str) -> str:
    """Return an estimator's family by what it needs: costs, gradients or both."""
    entry = registry.entries()["estimators"].get(estimator)
    needs = getattr(entry and entry.plugin, "needs", None)
    if not isinstance(needs, frozenset):  # of an estimator whose parameters decide what it needs
        return "costs only"
    if "grad" in needs:
        return "gradients and costs" if needs & {"value", "score"} else "gradients of the program"
    return "costs only"
