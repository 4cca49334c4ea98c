"""Builds the main study's page: error against time, bias and variance along each axis, and bias against variance."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from bench.experiment import axes
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import number_problems
from bench.model import registry
from bench.report.problems import ProblemRows, split_by_problem
from bench.report.style import Styles
from bench.report.text import axis_value, counted, duration, number
from bench.report.views import (
    CATEGORIES,
    Arranged,
    Curve,
    arrange,
    attempted,
    estimator_curves,
    estimator_labels,
    is_bias_resolved,
    rmse_interval,
    unsteady,
)
from bench.report.web.content import (
    DASHES,
    STATUS,
    SYMBOLS,
    Chart,
    Content,
    PlotAxis,
    TableColumn,
    identity_columns,
    look,
    no_result_sentence,
    titled,
)
from bench.studies.bias_variance.costs import EQUAL_ROLLOUTS, with_errors_at_equal_cost
from bench.studies.bias_variance.findings import lowest, problems_by_axis, span, winners
from bench.studies.bias_variance.panels import FLOOR

BIAS = PlotAxis(
    "bias_shown", "relative bias |bias| / |∇J|", True, "bias_from", "bias_to", "bias_limit", "larger than the gradient"
)
VARIANCE = PlotAxis("variance_rel", "relative variance of one estimate", True, "variance_from", "variance_to")
RMSE = PlotAxis("rmse_rel", "relative RMSE of one estimate", above_one="worse than the zero estimate")
TIMES = (
    PlotAxis("time_s", "time of one estimate [s]"),
    PlotAxis("time_total_s", "time of the first estimate, with compilation [s]"),
    PlotAxis("rollouts", "rollouts of one estimate"),
)
RESULTS = [
    TableColumn("bias_shown", "rel. bias", "limit", "bias_limit"),
    TableColumn("variance_rel", "rel. variance"),
    TableColumn("rmse_rel", "rel. RMSE"),
    TableColumn("cosine", "cosine"),
    TableColumn("compile_s", "compile", "seconds"),
    TableColumn("rollouts", "rollouts"),
]
POOLED = ("horizon", "dt", "stiffness", "sigma", "smoothing")
TIME = TableColumn("time_s", "time", "seconds", "unsteady")
GOAL = 0.1
"""Relative RMSE for which the fastest estimator and backend are named."""
IN_SIGHT = 5
"""Number of identity columns left of time, status, reason and results, so that a narrow screen shows those too."""
NAMED = 3
"""Most estimators whose failures the finding names."""
EXCEPTIONS = 2
"""Most exceptions (ranges with another best estimator) that the finding names."""


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the content of the page: the finding, the recommended estimators, the charts and the table."""
    shown = arrange(experiment, with_errors_at_equal_cost(rows))
    summaries = [ProblemSummary(axis, problem) for axis, problem in problems_by_axis(shown)]
    table_ = with_plotted_columns(rows)
    labelled = with_plotted_columns(shown.rows)
    charts = [
        Chart(
            "Error against time",
            "Each point is one cell. Lower left is better; above 1 an estimate is worse than the zero estimate. "
            "Points with a ring are not beaten in both by any point shown of the same problem.",
            TIMES,
            [RMSE, BIAS],
            facet="problem",
            front="setting",
        )
    ]
    tables = {}
    swept = shown.swept()
    for axis in sorted(swept, key=lambda a: -swept[a]):
        name = axis.column
        table = _along(replace(shown, rows=labelled), axis)
        if not table.empty:
            tables[name] = table
            marks = dict(shown.marks(axis))
            text = "Bars are 95% intervals. A hollow marker is the upper limit of a bias that cannot be distinguished from 0."
            shape = {"table": name, "facet": "facet", "line": "line", "marks": marks}
            x = [PlotAxis("x", axis.title)]
            charts.append(Chart(f"Bias and variance along {name}", text, x, [BIAS, VARIANCE, RMSE], **shape))  # type: ignore[arg-type]
    charts.append(
        Chart(
            "Bias against variance",
            "Towards the left more samples do not help; towards the top the error is bias.",
            [VARIANCE],
            [BIAS],
            facet="problem",
        )
    )
    return Content(
        finding=no_result_sentence(rows)
        or _join_sentences(failure_sentence(rows), finding(summaries), fastest(rows), refusal_sentence(rows)),
        rows=table_,
        columns=[*identity_columns(rows)[:IN_SIGHT], TIME, *STATUS, *RESULTS, *identity_columns(rows)[IN_SIGHT:]],
        charts=charts,
        answers=answers(summaries),
        tables=tables,
        looks=estimator_looks(rows),
    )


def with_plotted_columns(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the columns that charts draw: errors in units of |grad J|, and labels of points and lines."""
    norm = rows["reference_norm"].where(rows["reference_norm"] > 0)
    limit = ~is_bias_resolved(rows)
    values = {
        "bias_shown": (rows["bias"].where(~limit, rows["bias_high"]) / norm).clip(lower=FLOOR),
        "bias_from": (rows["bias_low"] / norm).clip(lower=FLOOR),
        "bias_to": rows["bias_high"] / norm,
        "variance_rel": rows["variance"] / norm**2,
        "variance_from": rows["variance_low"] / norm**2,
        "variance_to": rows["variance_high"] / norm**2,
        "time_total_s": rows["time_s"] + rows["compile_s"].fillna(0.0),
    }
    good = rows["status"] == "ok"
    texts = {
        "bias_limit": limit.astype(float),
        "unsteady": unsteady(rows).astype(float),
        "series": estimator_labels(rows),
        # one panel per value of each parameter that changes the cost of an estimate
        "problem": titled(rows.assign(**_named(rows)), ["scene", "contact", *POOLED]),
        "line": rows["backend"] + " " + rows["dtype"] + " " + estimator_labels(rows),
        "setting": number_problems(rows).astype(str),
    }
    return rows.assign(**{name: column.where(good) for name, column in values.items()}, **texts)


def _named(rows: pd.DataFrame) -> dict[str, Iterable[str]]:
    """Return the :data:`POOLED` columns as strings, ``sigma=0.1``; empty if a column has one value or a row has none."""
    several = {name: rows[name].nunique() > 1 for name in POOLED}
    return {
        name: [f"{name}={axis_value(x)}" if several[name] and math.isfinite(x) else "" for x in rows[name]]
        for name in POOLED
    }


def _along(shown: Arranged, axis: axes.Axis) -> pd.DataFrame:
    """Return the points along an axis, seeds merged, for the problems with at least two values of the axis."""
    rows = shown.rows
    place = pd.Series(range(len(rows)), index=rows["key"])
    drawn = [BIAS.column, BIAS.low, BIAS.high, BIAS.limit, VARIANCE.column, VARIANCE.low, VARIANCE.high, RMSE.column]
    merged = rows["seed"].nunique() > 1
    parts = []
    for problem in split_by_problem(shown, axis, ("scene", "contact")):
        part = problem.rows[problem.rows["status"] == "ok"]
        if part["x"].nunique() > 1:
            part = part.sort_values(["line", "x"], kind="stable").assign(
                facet=problem.title(), row=part["key"].map(place), series=estimator_labels(part)
            )
            parts.append(part[["row", "x", "facet", "series", "line", *(drawn if merged else [])]])
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def estimator_looks(rows: pd.DataFrame) -> dict[str, dict[str, object]]:
    """Return the colour, marker and line style of every estimator in the rows, the same as in the figures."""
    styles = Styles(rows, sorted(registry.entries()["estimators"]))
    looks = {}
    for estimator, params in dict.fromkeys(zip(rows["estimator"], rows["estimator_params"], strict=True)):
        line = Curve(estimator, params, {}, rows.iloc[:0], {}, frozenset(), 0)
        style = styles.marked(line)
        looks[line.label] = look(style["color"], SYMBOLS[style["marker"]], DASHES[str(style["linestyle"])])
    return looks


# ------------------------------------------------------------------------------------------------------ finding


class ProblemSummary:
    """One problem along an axis: the estimators with the lowest error at equal rollouts, by value of the axis."""

    def __init__(self, axis: axes.Axis | None, problem: ProblemRows) -> None:
        self.axis, self.title = axis, problem.title()
        self.kind = ", ".join(str(value) for name, value in problem.identity.items() if name in CATEGORIES)
        self.lines = estimator_curves(problem.rows)
        self.lowest = lowest(self.lines, EQUAL_ROLLOUTS)
        self.winners = winners(self.lines, EQUAL_ROLLOUTS)

    def errors(self, label: str, places: Iterable[float]) -> list[float]:
        """Return an estimator's relative RMSEs at equal rollouts at some values of the axis, per group of agreeing backends."""
        rows = [line.at[x] for x in places for line in self.lines if line.label == label and x in line.at]
        return [row[EQUAL_ROLLOUTS] for row in rows if row["status"] == "ok" and math.isfinite(row[EQUAL_ROLLOUTS])]

    def where(self, places: Sequence[float]) -> str:
        """Format some values of the axis as a range: ``stiffness >=1e4``; empty for all values."""
        text = span({x: x in places for x in self.lowest})
        return f"{self.axis.column} {text}" if self.axis and text else ""


@dataclass(frozen=True)
class BetterElsewhere:
    """A range where the most frequently best estimator is not the best: the better estimator, and the errors of both."""

    problem: str
    kind: str
    where: str
    use: str
    errors: list[float]
    instead_of: list[float]

    @property
    def factor(self) -> float:
        """Largest error of the most frequently best estimator over the smallest error of the better one."""
        worse = max(self.instead_of, default=math.inf)
        return worse / min(self.errors) if min(self.errors) > 0 else math.inf

    def sentence(self, main: str) -> str:
        """Format the exception: ``pushing, penalty, stiffness >=1e4: use reinforce (0.5, where fobg has 300)``."""
        where = ", ".join(filter(None, [self.problem, self.where])) or "elsewhere"
        return f"{where}: use {self.use} ({range_text(self.errors)}, where {main} has {range_text(self.instead_of)})"


def failure_sentence(rows: pd.DataFrame) -> str:
    """Format which estimators fail, and in how many cells: worse than the zero estimate, no better, or without a number.

    An estimator is worse if its 95% interval lies above the zero estimate's error. At most :data:`NAMED` estimators are
    named, the largest error first. The string is empty if none fails.
    """
    failures = []
    for label, part in attempted(rows).groupby(estimator_labels(attempted(rows)), sort=False):
        good = part[(part["status"] == "ok") & np.isfinite(part["rmse_rel"])]
        bad = good[good["rmse_rel"] >= 1]
        lows = rmse_interval(bad)[0]
        worse, lost = int((lows > 1).sum()), int((part["status"] != "ok").sum())
        texts = [
            f"worse than the zero estimate in {worse} (up to {number(bad['rmse_rel'].max())} times the gradient)"
            if worse
            else "",
            f"no better than zero in {len(bad) - worse}" if len(bad) > worse else "",
            f"without a number in {lost}" if lost else "",
        ]
        if any(texts):
            worst = float(bad["rmse_rel"].max()) if len(bad) else 0.0
            failures.append((worst, f"{label} is {', '.join(filter(None, texts))} of {counted(len(part), 'cell')}"))
    failures.sort(key=lambda failure: -failure[0])
    return "; ".join(text for _, text in failures[:NAMED])


def _join_sentences(*parts: str) -> str:
    """Join the parts that are not empty into one sentence; only its first part keeps a capital."""
    texts = [part for part in parts if part]
    return "; ".join([*texts[:1], *(part[0].lower() + part[1:] for part in texts[1:])]) + "."


def finding(summaries: Sequence[ProblemSummary]) -> str:
    """Format the finding: the estimator that most often has the lowest error at equal rollouts, and exceptions."""
    settings = [(one, x) for one in summaries for x in one.lowest]
    if not settings:
        return "No cell has an error that could be compared"
    labels = list(dict.fromkeys(line.label for one in summaries for line in one.lines))
    wins = {label: [(one, x) for one, x in settings if label in one.winners[x]] for label in labels}
    main = min(labels, key=lambda label: (-len(wins[label]), labels.index(label)))
    errors = [one.lowest[x] for one, x in wins[main]]
    share = f"{len(errors)} of {counted(len(settings), 'setting')}"
    if len(errors) == len(settings):
        share = f"all {counted(len(settings), 'setting')}" if len(settings) > 1 else "the one setting"
    text = f"Use {main}: lowest relative RMSE at equal rollouts in {share} ({range_text(errors)})"
    if min(errors) >= 1:
        text = f"Nothing beats the zero estimate: even {main}, lowest in {share}, has a relative RMSE of {range_text(errors)} at equal rollouts"
    others = exceptions_to(summaries, main)
    left = counted(len(others) - EXCEPTIONS, "further exception") if len(others) > EXCEPTIONS else ""
    return "; ".join(filter(None, [text, *(other.sentence(main) for other in others[:EXCEPTIONS]), left]))


def fastest(rows: pd.DataFrame) -> str:
    """Format which estimator and backend most often reach :data:`GOAL` in the least time.

    The string is empty with a single backend, or if fewer than two settings reach it.
    """
    good = rows[(rows["status"] == "ok") & (rows["rmse_rel"] <= GOAL) & np.isfinite(rows["time_s"])]
    if rows["backend"].nunique() < 2 or good.empty:
        return ""
    settings = good["time_s"].groupby(number_problems(good))
    first = good.loc[settings.idxmin()]
    ways = estimator_labels(first) + " on " + first["backend"]
    way = ways.value_counts().index[0]
    times = sorted(first.loc[ways == way, "time_s"])
    if len(first) < 2:
        return ""
    share = f"{len(times)} of the {counted(len(first), 'setting')} where any does"
    return f"a relative RMSE of {GOAL:g} is reached first by {way} in {share} ({duration(times[0])} to {duration(times[-1])})"


def refusal_sentence(rows: pd.DataFrame) -> str:
    """Format which backends refused every cell, with the most frequent reason; empty if none did."""
    left = rows[(rows["status"] == "unsupported") & ~rows["backend"].isin(attempted(rows)["backend"])]
    reasons = left.groupby("backend", sort=False)["reason"].agg(lambda reasons: reasons.mode().iloc[0])
    return "; ".join(f"{backend} refuses: {reason}" for backend, reason in reasons.items())


def exceptions_to(summaries: Sequence[ProblemSummary], main: str) -> list[BetterElsewhere]:
    """Return the ranges where an estimator other than ``main`` is best, the largest error ratio first.

    An exception that applies to every problem with the same scene and contact law is listed once.
    """
    exceptions = []
    for one in summaries:
        places = [x for x, labels in one.winners.items() if main not in labels]
        for use in dict.fromkeys(one.winners[x][0] for x in places):
            mine = [x for x in places if one.winners[x][0] == use]
            errors, instead_of = [one.lowest[x] for x in mine], one.errors(main, mine)
            exceptions.append(BetterElsewhere(one.title, one.kind, one.where(mine), use, errors, instead_of))
    merged = []
    for other in exceptions:
        alike = [e for e in exceptions if (e.kind, e.where, e.use) == (other.kind, other.where, other.use)]
        if len(alike) < sum(one.kind == other.kind for one in summaries):
            merged.append(other)
        elif alike[0] is other:
            both = [[v for e in alike for v in getattr(e, name)] for name in ("errors", "instead_of")]
            merged.append(BetterElsewhere(other.kind, other.kind, other.where, other.use, *both))
    return sorted(merged, key=lambda other: -other.factor)


def answers(summaries: Sequence[ProblemSummary]) -> pd.DataFrame:
    """Return the recommended estimators, one line per problem and range of its axis with the same best estimators."""
    entries = []
    for one in summaries:
        groups: dict[tuple[str, ...], list[float]] = {}
        for x, names in one.winners.items():
            groups.setdefault(tuple(names), []).append(x)
        every = list(dict.fromkeys(line.label for line in one.lines))
        for labels, places in groups.items():
            errors = {label: one.errors(label, places) for label in every}
            rest = {label: float(np.median(errors[label])) for label in every if label not in labels and errors[label]}
            following = min(rest, key=lambda label: rest[label], default="")
            useless = [label for label in every if errors[label] and min(errors[label]) >= 1]
            entries.append(
                {
                    "problem": one.title,
                    "where": one.where(places) or "everywhere",
                    "use": ", ".join(labels),
                    "relative RMSE at equal rollouts": range_text(one.lowest[x] for x in places),
                    "next best": f"{following} ({number(rest[following])})" if following else "-",
                    "worse than the zero estimate": ", ".join(useless) or "-",
                }
            )
    return pd.DataFrame(entries)


def range_text(values: Iterable[float]) -> str:
    """Format the range of values: ``0.12``, or ``0.10 to 0.15``; ``no result`` without values."""
    numbers = list(values)
    if not numbers:
        return "no result"
    low, high = number(min(numbers)), number(max(numbers))
    return low if low == high else f"{low} to {high}"
