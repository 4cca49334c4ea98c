"""The charts of the main study: errors along each axis, error against cost, and estimators by problem."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from bench.errors import unknown
from bench.experiment.axes import Axis
from bench.experiment.columns import COMMON, Column, interval, text
from bench.experiment.parameters import PROBLEM
from bench.experiment.views import Chart, Mark, Style
from bench.model import SURROGATE, registry
from bench.report.colours import graded, method_styles
from bench.report.names import setting, short_names
from bench.report.problems import ProblemRows, joined, problem_numbers, split_by_problem, titled
from bench.report.style import colour, marker
from bench.report.text import axis_value, counted, number, rounded, short_duration
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
from .time_to_accuracy import SAMPLES, TARGETS, TIME, methods_by_cost, with_known

FLOOR = 1e-4
"""Relative errors below this are drawn here, as upper limits."""
GRADES = {0.1: "#08519c", 0.3: "#6baed6", 1.0: "#d6e6f4", 10.0: "#fdae61", math.inf: "#c51b1b"}
"""Upper ends of the grades of an error, and their colours."""
BEHIND = {3.0: "#6baed6", 10.0: "#d6e6f4", math.inf: "#fdae61"}
"""Upper ends of the grades of a factor to the first method, and their colours."""
LEADS = "first, or tied: the 95% interval of its factor to the first reaches 1"
LIMIT = "<: an upper limit, 10 or more times the first"
SAME_LINE = 0.03
"""Largest relative difference of backends that are one line."""
PANELS = 4
"""Most problems of a chart along an axis."""
RMSE = Column(
    "rmse_rel",
    label="relative RMSE of one estimate",
    low="rmse_low",
    high="rmse_high",
    limit="rmse_limit",
    log=True,
    least=FLOOR,
    above_one="worse than the zero estimate",
)
BIAS = Column(
    "bias_shown",
    label="relative bias",
    low="bias_from",
    high="bias_to",
    limit="bias_limit",
    log=True,
    least=FLOOR,
    above_one="larger than the gradient",
)
COST = interval("cost", log=False, ends="95% of the rollouts", doc="costs of the same rollouts")
SECONDS = replace(COLUMNS.by_name["time_s"], label="time of one estimate", log=True)
FASTEST = "each estimator on its fastest backend"
SERIES = text("series", label="")


def charts(
    shown: Arranged,
    methods: pd.DataFrame,
    best: pd.DataFrame,
) -> list[Chart]:
    """Return all charts, the main one first."""
    labelled = replace(shown, rows=with_plotted_columns(shown.rows))
    subtitle = _conditions(shown, shown.rows)
    swept = shown.swept()
    order = sorted(swept, key=lambda a: (-swept[a], a.column not in ("stiffness", "samples")))
    is_timed = shown.rows["time_s"].notna().any() and "contacts" not in shown.experiment.compares
    along = [
        _cost_of_accuracy(shown, best, subtitle) if axis.column == "samples" and is_timed else _along(labelled, axis)
        for i, axis in enumerate(order)
        if not any(axis.column in other.moves for other in order[:i])  # axes that step together have one chart
    ]
    along = [_error_and_time(labelled, subtitle), *along]
    is_grid = (methods[["setting", "estimator"]].nunique() > 1).all()
    if max(swept.values(), default=0) < LEAST and is_grid:
        along = [_estimators(methods), *along]
    return [*filter(None, along)]


# ------------------------------------------------------------------------------------------------------- frames


def with_plotted_columns(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the columns that charts draw: errors in units of |grad J|, and labels of points and lines."""
    norm = rows["reference_norm"].where(rows["reference_norm"] > 0)
    limit = ~(rows["bias_low"] > 0)
    error, low, high, is_limit = (pd.Series(part, rows.index) for part in shown_rmse(rows))
    values = {
        "rmse_rel": error,
        "rmse_low": low,
        "rmse_high": high,
        "bias_shown": rows["bias"].where(~limit, rows["bias_high"]) / norm,
        "bias_from": rows["bias_low"] / norm,
        "bias_to": rows["bias_high"] / norm,
    }
    good = rows["status"] == "ok"
    return rows.assign(
        **pd.DataFrame(values).where(good),
        rmse_limit=is_limit,
        bias_limit=limit,
        series=estimator_labels(rows),
        failed=~good,
    )


def _conditions(shown: Arranged, drawn: pd.DataFrame) -> str:
    """Return what all panels share: samples of the ``drawn`` rows, medians over seeds, surrogate gradients."""
    rows, samples = shown.rows, drawn["samples"].dropna().unique()
    scenes, seeds = (rows[name].unique() for name in ("scene", "seed"))
    laws = rows.loc[rows["reason"].str.contains(SURROGATE, regex=False), "contact"].unique()
    return ", ".join(
        [
            *[*short_names(scenes).values()] * (len(scenes) == 1),
            *[f"{count:g} samples" for count in samples if len(samples) == 1],
            *[f"medians over {len(seeds)} seeds"] * (len(seeds) > 1),
            *(f"{law}: {SURROGATE}" for law in laws),
        ]
    )


# ---------------------------------------------------------------------------------------------- along an axis


def _along(shown: Arranged, axis: Axis) -> Chart | None:
    """Return the chart of errors along an axis, of the main estimators on the main problems."""
    always = ("scene",) * (shown.rows["scene"].nunique() > 1)
    problems = [p for p in split_by_problem(shown, axis, always) if attempted(p.rows)["x"].nunique() > 1]
    if not problems:
        return None
    drawn, notes = choose_problems(problems)
    compares = shown.experiment.compares
    compared = next((column for column in ("backend", "contact") if f"{column}s" in compares), "")
    series = compares.get(f"{compared}s", ())
    rows = attempted(pd.concat(problem.rows for problem in problems))
    labels = (rows[_is_named(rows[compared], series)] if compared else rows)["series"].unique()
    # where the experiment names no estimators, a chart along an axis has the first six
    names = compares.get("estimators") or labels[:6]
    shares = [f"{len(names)} of {len(labels)} estimators"] * (len(names) < len(labels))
    lines = [_lines(problem, compared, series).set_index("label", drop=False) for problem in drawn]
    frame = pd.concat((each.loc[[name for name in names if name in each.index]] for each in lines), ignore_index=True)
    notes += ["backends that agree lie on each other"] * (compared == "backend")
    of_steps = frame[frame["horizon"].notna() & (axis.unit == "steps")]
    marks = [Mark(f"beyond the {name}", value, math.inf) for name, value in shown.marks(axis).items()]
    stem, what, y = "bias_variance", "error", [RMSE, BIAS]
    if axis.column == "samples" and compared == "contact":
        stem, what, y = "time", "time", [SECONDS]
    return Chart(
        f"{stem}_" + re.sub(r"\W", "_", axis.column),
        frame,
        [Column("x", label=axis.title, format="setting")],
        y,
        series="series",
        title=f"How does the {what} of one estimate depend on {axis.column.replace('_', ' ')}?",
        panel="panel",
        marks=marks,
        failed="failed",
        across=len(names) if compared else len(drawn),
        styles=_looks(frame["series"].unique() if compared else ()),
        subtitle=", ".join(
            filter(
                None,
                [
                    f"{axis.short}: {axis.doc}" * (axis.doc != "" and axis.column not in COMMON),
                    _conditions(shown, frame),
                    *notes,
                    *shares,
                ],
            )
        ),
        panel_notes=dict(zip(of_steps["panel"], of_steps["horizon"].map("rollouts of {:g} steps".format), strict=True)),
    )


def _is_named(found: pd.Series, names: Sequence[Any]) -> pd.Series:
    """Return whether each value is among the names, by itself or without its parameters."""
    return found.isin(names) | found.astype(str).str.partition("[")[0].isin(names)


def _lines(problem: ProblemRows, compared: str, names: Sequence[str]) -> pd.DataFrame:
    """Return the points of a problem: a line per estimator and backend, or per ``compared`` column in a panel per estimator.

    Backends that agree are one line unless they are compared.
    """
    curves = estimator_curves(problem.rows, None if compared == "backend" else SAME_LINE).assign(
        problem=problem.title()
    )
    if compared:
        others = joined({**problem.identity, compared: ""})
        curves = curves[_is_named(curves[compared], names)]
        # a law has its own backends, which decide its times
        backends = " on " + curves["backend"] if compared == "contact" else ""
        return curves.assign(
            series=curves[compared] + backends,
            panel=[joined({"": others, "label": label}) for label in curves["label"]],
        )
    # those that differ from the first are named after their backends
    first = curves["curve"] == curves.groupby("label")["curve"].transform("min")
    other = curves["method"] + f": over {SAME_LINE:.0%} apart"
    return curves.assign(series=curves["label"].where(first, other), panel=problem.title())


def _looks(names: Sequence[str]) -> dict[str, Style]:
    """Return looks of backends, or of contact laws with what they are."""
    return {
        name: Style(colour(i), marker(i), meaning=": ".join(filter(None, (short, _summary(name.partition(" on ")[0])))))
        for i, (name, short) in enumerate(short_names(names).items())
    }


def choose_problems(problems: Sequence[ProblemRows]) -> tuple[list[ProblemRows], list[str]]:
    """Return the problems to print, at most :data:`PANELS`, and notes on the problems omitted.

    Of problems that differ only in numbers, the first stands for all.
    """
    first: dict[str, ProblemRows] = {}
    for problem in problems if len(problems) > 2 else ():
        first.setdefault(problem.parts()[0], problem)
    chosen = list(first.values())[:PANELS] or list(problems)
    numbers = dict(item for problem in chosen for item in problem.parts()[1].items())
    held = ", ".join(setting(name, f"{value:g}") for name, value in numbers.items())
    shares = f"{len(chosen)} of {counted(len(problems), 'problem')}" + f" ({held})" * bool(held)
    return chosen, [shares] * (len(chosen) < len(problems))


# ----------------------------------------------------------------------------------------------- error and cost


def _error_and_time(shown: Arranged, subtitle: str) -> Chart | None:
    """Return error against time: a point is an estimator on its fastest backend, a panel a scene with a contact law.

    Two values of an axis that the experiment's ``compares`` names are joined by arrows, with the costs of the same rollouts below.
    """
    program = problem_numbers(shown.rows, PROBLEM)
    # cells of one program have the same costs, and those that use costs store them
    cost = shown.rows[[COST.name, COST.low, COST.high]].groupby(program).transform("first")
    rows = with_known(shown.rows.assign(**cost, panel=titled(shown.rows, ["scene", "contact"])), TIME)
    along, ends = None, list[Any]()
    for name, values in shown.experiment.compares.items():
        axis = next((axis for axis in shown.axes if name in (axis.column, axis.short)), None)
        column = axis.column if axis else {"estimators": "series"}.get(name, name.removesuffix("s"))
        if column not in rows:
            raise unknown("axis in compares", name, (*shown.numbers, "estimators", "backends", "contacts"))
        rows = rows[_is_named(rows[column], values)]
        along, ends = (axis, list(values)) if len(values) == 2 and axis else (along, ends)
    if rows.empty or (along is None and shown.swept()):
        return None
    pair = ["series", "panel"]
    times = rows.groupby([*pair, "backend", "dtype"])[TIME].transform("median")
    frame = rows[times == times.groupby([rows[name] for name in pair]).transform("min")]
    looks = method_styles(frame["series"].unique())
    chart = Chart(
        "speed_accuracy",
        frame,
        [SECONDS],
        [RMSE],
        "points",
        series="series",
        panel="panel",
        across=2,
        own_scales=True,
        title="What error has one estimate, and what time does it take?",
        subtitle=", ".join(filter(None, [subtitle, FASTEST])),
        panel_notes={panel: _summary(law) for panel, law in zip(frame["panel"], frame["contact"], strict=True)},
        styles={
            name: replace(look, meaning=f"{short_names(looks, is_whole=True)[name]}: {_family(name.partition('[')[0])}")
            for name, look in looks.items()
        },
    )
    if along is None:
        return chart
    frame = frame.sort_values(along.column, key=lambda at: at == ends[-1], kind="stable")
    pairs = frame.groupby(pair)
    # one program at both settings: what differs is noise
    frame = frame.assign(**{TIME: pairs[TIME].transform("median")}, arrow=frame["series"] + ", " + frame["panel"])
    moved = (pairs["cost"].agg(np.ptp) / pairs["cost"].mean().abs()).max()
    is_costed = bool(moved == moved)
    change = f"{along.column} {' to '.join(f'{end:,g}' for end in ends)} {along.unit}".rstrip()
    look_right = f"; {change} changes the costs by at most {number(100 * moved)}%: only the errors tell"
    return replace(
        chart,
        name="contrast",
        frame=frame,
        y=[replace(RMSE, low="", high=""), *[COST] * is_costed],
        subtitle=chart.subtitle + look_right * is_costed,
        arrow="arrow",
        arrow_name=change,
    )


def _summary(contact: str) -> str:
    """Return what kind of contact a law has, in the first words of its module."""
    entry = registry.entries()["contacts"].get(contact.partition("[")[0])
    doc = (sys.modules[entry.plugin.__module__].__doc__ or "") if entry and entry.plugin else ""
    return re.split("[:.]", doc)[0].lower()


def _cost_of_accuracy(shown: Arranged, best: pd.DataFrame, subtitle: str) -> Chart | None:
    """Return the time of each estimator to reach an error, as a table whose colours are its factor to the first of each problem.

    Problems that differ in numbers only, as in the descent, are in panels of their own. Where backends are compared, each has
    a panel; else an estimator is on its fastest.
    """
    if best.empty:
        return None
    target, backends = TARGETS[0], shown.experiment.compares.get("backends", ())
    lead = best[(best["by"] == "time") & (best["relative error"] == target)].set_index("problem")
    lines: list[dict[str, Any]] = [
        {
            "title": problem.title(),
            "problem": problem.parts()[0],
            "panel": joined(problem.parts()[1]),
            "series": name.partition(" on ")[0],
            "backend": name.partition(" on ")[2],
            "cost": needed.cost,
            "sign": "<" * (needed.how == "at once"),
            "leads": name in (lead["fastest"][problem.title()], *lead["tied"][problem.title()]),
        }
        for problem in split_by_problem(shown, SAMPLES, ("scene",))
        if problem.title() in lead.index
        for name, needed in methods_by_cost(problem, target, TIME).items()
    ]
    if not any(np.isfinite(line["cost"]) for line in lines):
        return None
    frame = pd.DataFrame(lines).sort_values("cost")
    frame = frame.drop_duplicates(["title", "series", *["backend"] * bool(backends)]).sort_index()
    frame = frame[frame["backend"].isin(backends or frame["backend"]) & np.isfinite(frame["cost"])]
    factor = frame["cost"] / frame.groupby("title")["cost"].transform("min")
    differs = bool(frame.groupby("problem")["title"].nunique().max() > 1)
    frame["panel"] = titled(frame, ["backend"] * bool(backends) + ["panel"] * differs)
    grades, looks = graded(factor, BEHIND, "{} times the first".format, "{:g}".format)
    grades = grades.mask((frame["sign"] == "<") & (factor >= 10.0), LIMIT)  # fewer samples may do
    return Chart(
        "speed_accuracy",
        frame.assign(
            grade=grades.mask(frame["leads"], LEADS),
            cell=frame["sign"] + frame["cost"].map(short_duration),
        ),
        [text("problem", label="")],
        [SERIES],
        "grid",
        panel="panel",
        level="grade",
        cell="cell",
        across=1,
        styles={LEADS: Style(GRADES[0.1])} | looks | {LIMIT: Style("#bdbdbd")},
        failed_name="not known to be reached",
        title=f"Which method reaches an error of {target:.0%} first?",
        subtitle=", ".join(
            filter(None, [f"time to a relative error of {target:.0%}", subtitle, "" if backends else FASTEST])
        ),
    )


# --------------------------------------------------------------------------------------------------- estimators


def _estimators(methods: pd.DataFrame) -> Chart:
    """Return the heat table of errors: estimators by their worst case, in families, against problems."""
    # the first value of an axis is shown
    methods = methods.drop_duplicates(["estimator", "problem"])
    worst = methods["error"].where(methods["status"] == "ok", math.inf).groupby(methods["estimator"]).transform("max")
    frame = methods.loc[worst.sort_values(kind="stable").index]
    axis, at = frame[["axis", "at"]].iloc[0]
    error, known = frame["error"], np.isfinite(frame["error"])
    marks = frame["status"].where(frame["verdict"] == NO_RESULT, "").mask(frame["verdict"] == FAILS, " fails")
    at_equal = setting(axis, axis_value(at)) if axis not in ("", "rollouts") else ""
    spent = " to ".join(dict.fromkeys(map(axis_value, methods["rollouts"].agg(["min", "max"]).round())))
    grades, looks = graded(error.map(rounded), GRADES, "error {}".format, "{:g}".format)
    return Chart(
        "estimators",
        frame.assign(
            panel=[_family(name.partition("[")[0]) for name in frame["estimator"]],
            series=frame["estimator"],
            grade=grades.where(known, "no result"),
            cell=(frame["error_is_limit"].map({True: "<"}).fillna("") + error.map(number)).where(known, marks),
        ),
        [text("problem", label="")],
        [SERIES],
        "grid",
        panel="panel",
        level="grade",
        styles=looks | {"no result": Style("#f2f2f2")},
        cell="cell",
        across=1,
        title="Where does each estimator win, and where does it fail?",
        failed_name="cannot be used",
        subtitle=", ".join(
            filter(
                None,
                [
                    f"relative RMSE at equal rollouts ({spent})",
                    at_equal,
                    "sorted by the worst case; from 1 on the zero estimate is better",
                ],
            )
        ),
    )


def _family(estimator: str) -> str:
    """Return an estimator's family by what it needs: costs, gradients or both, and the jumps of the cost."""
    entry = registry.entries()["estimators"].get(estimator)
    plugin: Any = entry and entry.plugin
    needs = getattr(plugin, "needs", None)
    # an estimator whose parameters decide what it needs has a property here, not a set
    if not isinstance(needs, frozenset) or "grad" not in needs:
        return "costs only"
    if needs == {"grad"}:
        return "gradients of the program"
    knows_jumps = needs == {"grad", "value"} and plugin.unbiased_at_discontinuities
    return "gradients, costs and the jumps that the scene declares" if knows_jumps else "gradients and costs"
