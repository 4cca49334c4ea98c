"""What the main study shows of its rows: comparisons with intervals, and the tables and charts from them."""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment import axes
from bench.experiment.axes import Axis
from bench.experiment.columns import IDENTITY, Column, interval, setting, text
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import number_problems
from bench.experiment.views import Table, Views
from bench.report.problems import ProblemRows
from bench.report.text import axis_value, counted, number, span
from bench.report.views import arrange, pareto, shown_rmse

from . import charts, descents, time_to_accuracy, trust
from .columns import COLUMNS
from .comparisons import (
    COMPARED,
    ERROR,
    FAILS,
    LAW,
    NO_RESULT,
    WORKS,
    Problems,
    at_equal_rollouts,
    compare_errors,
    lowest,
    method_table,
    problems_by_axis,
    setting_names,
    verdict,
    verdicts_by_estimator,
)
from .time_to_accuracy import ROLLOUTS, limits, with_gradient_cost

RESULTS = ("variance", "cosine", "rollouts", "gradients", "reference_method")


def views(experiment: Experiment, rows: pd.DataFrame) -> Views | None:
    """Return the tables and charts of the rows; None if no cell was run."""
    rows = descents.with_start_norm(rows)
    rows = rows.assign(trusted=trust.trusted(experiment.results_dir, rows))
    costed = with_gradient_cost(rows)
    shown = arrange(experiment, costed)
    problems = problems_by_axis(shown)
    methods = method_table(problems)
    if methods.empty:
        return None
    equal = at_equal_rollouts(methods)
    errors = compare_errors(equal)
    best = time_to_accuracy.table(shown)
    return Views(
        tables(experiment, rows, pivots(problems, lowest(equal)), methods, equal, errors, best)
        + descents.tables(shown),
        charts.charts(shown, equal, best),
        rows=charts.with_plotted_columns(costed),
        columns=[
            *(replace(c, label=label) for c, label in ((charts.RMSE, "rel. RMSE"), (charts.BIAS, "rel. bias"))),
            replace(COLUMNS.by_name["time_s"], label="time"),
            *(COLUMNS.by_name[name] for name in RESULTS),
        ],
        remarks=loose_references(rows, experiment.reference.tolerance),
        headline=trust.headline(rows["trusted"]),
    )


def loose_references(rows: pd.DataFrame, tolerance: float) -> list[str]:
    """Return in how many cells the reference's relative standard error is above the experiment's ``tolerance``, and the largest."""
    good = rows[(rows["status"] == "ok") & (rows["reference_norm"] > 0)]
    error = good["reference_se"] / good["reference_norm"]
    loose = error[error > tolerance]
    if loose.empty:
        return []
    return [
        f"the standard error of the reference is above its tolerance of {100 * tolerance:g}% in {counted(len(loose), 'cell')}, up to "
        f"{100 * loose.max():.2g}% ({good.loc[loose.idxmax(), 'scene']}): more reference.samples make it smaller"
    ]


FAILURES = {
    "nonfinite": ("∞", "a result that is not finite"),
    "diverged": ("↑", "a state that diverged"),
    "timeout": ("⧗", "the time limit"),
    "crashed": ("†", "a process that died"),
    "error": ("‡", "an error"),
    "unsupported": ("–", "a combination that cannot work"),
    "unavailable": ("∅", "a library that is not installed"),
    "waiting": ("…", "a rung of a ladder whose lower rung has not passed"),
}
"""Sign and meaning of each status other than ``ok``."""
REMARKED = "?"
"""Mark of a cell whose row has a remark."""
FEWEST_RANKED = 3
"""Fewest estimators for which the ranking is written; the main table is enough for fewer."""
ESTIMATOR = text("method", label="estimator")


def tables(
    experiment: Experiment,
    rows: pd.DataFrame,
    pivoted: list[Table],
    methods: pd.DataFrame,
    equal: pd.DataFrame,
    errors: pd.DataFrame,
    best: pd.DataFrame,
) -> list[Table]:
    """Return the tables of errors, the ``pivoted`` ones first.

    ``equal`` has the methods at equal rollouts, ``best`` is the table of the cost to reach an error.
    """
    main, *others = pivoted
    is_ranked = methods["estimator"].nunique() >= FEWEST_RANKED and methods["problem"].nunique() > 1
    names = {name: errors[name].map(", ".join) for name in ("tied", "not_comparable")}
    joined = errors.drop(columns=["setting", "leaders"]).assign(**names)
    columns = [replace(c, note="factor_note") if c.name == "factor" else c for c in COMPARED]
    title = "the first and the next at each setting, at equal rollouts"
    return [
        replace(main, data=axes.table(experiment, rows)),
        *others,
        Table("speed_accuracy", speed_accuracy(rows)),
        *([ranking(methods, equal)] if is_ranked else []),
        recommendations(equal),
        Table("verdicts", methods.drop(columns=["setting", "has_law", *LAW])),
        Table("comparisons", joined.assign(factor_note=limits(joined)), columns, title, COMPARISON_NOTES, data=joined),
        *([] if best.empty else [time_to_accuracy.accuracy_table(best)]),
    ]


COMPARISON_NOTES = (
    "Rollouts: of one estimate of each method, the number at which most methods are known, as measured or by RMSE^2 = bias^2 + v / N; "
    "a gradient counts as the rollouts that take as long (as one where that was not measured). Not comparable: methods that "
    "choose samples together, or whose bias may depend on their number, at other rollouts than measured. Factor: the second over the first, with its 95% interval; none for an upper limit, which is never first. Tied: not "
    "distinguishable from the first, since the interval of the factor reaches 1 or is not known.",
)


# ------------------------------------------------------------------------------------------- along an axis


def pivots(problems: Problems, best: Container[tuple[str, str]]) -> list[Table]:
    """Return a table per problem: estimators down, values of its longest axis across, each cell a relative RMSE.

    Beside them stand the cost and the time of one estimate. ``best`` are the settings and methods in bold.
    """
    result = [_pivot(axis, problem, best) for axis, problem in problems]
    return [*result[:-1], replace(result[-1], notes=_notes(result))]


def _pivot(axis: Axis | None, problem: ProblemRows, best: Container[tuple[str, str]]) -> Table:
    rows = problem.rows
    ok, note = rows["status"] == "ok", rows["status"].map(lambda status: FAILURES.get(status, [""])[0])
    error, low, high, is_limit = (pd.Series(part, rows.index) for part in shown_rmse(rows))
    error, low, high = (part.where(ok) for part in (error, low, high))
    settings = setting_names(problem, axis, rows)
    is_best = [pair in best for pair in zip(settings, rows["method"], strict=True)]
    cells = pd.DataFrame(
        {
            "": error,
            "_low": low,
            "_high": high,
            "_limit": is_limit,
            "_best": (error < 1) & np.array(is_best, dtype=bool),
            "_note": note + np.where(rows["reason"] != "", REMARKED, ""),
        }
    ).set_axis(rows["method"])
    values = sorted(rows["x"].unique())
    wide = _across(cells, rows["x"], values, "x").reindex(rows["method"].unique())
    is_swept = axis is not None and axis.column == "samples"
    per = rows["x"] if is_swept else 1
    spent = pd.DataFrame({"rollouts": rows[ROLLOUTS] / per, "time": rows["time_s"] / per}).groupby(
        rows["method"], sort=False
    )
    # if samples are few, most of the time is that of the call
    wide = pd.concat([wide, spent.last() if is_swept else spent.median()], axis=1).copy().rename_axis("method")
    columns = [
        interval(
            f"x{i}",
            label=axis_value(x) if axis else "relative RMSE",
            limit=f"x{i}_limit",
            emphasis=f"x{i}_best",
            note=f"x{i}_note",
        )
        for i, x in enumerate(values)
    ]
    each = "a sample" if is_swept else "an estimate"
    costs = [Column("rollouts", label=f"rollouts {each}"), Column("time", label=f"time {each}", format="seconds")]
    equal = "" if is_swept or rows["samples"].nunique() > 1 else f", at {axis_value(rows['samples'].iloc[0])} samples"
    return Table(
        "bias_variance",
        wide.reset_index(),
        [ESTIMATOR, *columns, *costs],
        f"relative RMSE{equal}: {problem.title()}{f', by {axis.title}' if axis else ''}",
        files=["csv", "md", "tex"],
        terminal=True,
    )


def _across(cells: pd.DataFrame, place: pd.Series, values: Sequence[Any], prefix: str) -> pd.DataFrame:
    """Return cells with those of each place side by side, their columns under the prefix and the number of the place."""
    parts = [cells[(place == value).to_numpy()].add_prefix(f"{prefix}{i}") for i, value in enumerate(values)]
    return pd.concat(parts, axis=1)


def _notes(result: Sequence[Table]) -> list[str]:
    """Return the notes below the tables: numbers, intervals, bold type and the signs that occur."""
    seen = {str(v) for table in result for name in table.frame if name.endswith("_note") for v in table.frame[name]}
    notes = [
        "Relative RMSE of one estimate [95% interval], in units of the reference gradient's norm: above 1 the zero estimate "
        "is better. Bold: below 1, with an interval apart from that of every other estimator at equal rollouts. Rollouts: cost of one "
        "estimate, a gradient as the rollouts that take as long (as one where that was not measured). <: upper limit, where the bias is not "
        "distinguishable from 0 and the reference's error is at least the standard deviation of one estimate."
    ]
    signs = [f"{sign}: {what}." for sign, what in FAILURES.values() if any(sign in text_ for text_ in seen)]
    if any(REMARKED in text_ for text_ in seen):
        signs.append(
            f"{REMARKED}: the row has a remark, so its interval is doubtful: see the column reason of the CSV."
        )
    return notes + ([" ".join(signs)] if signs else [])


# --------------------------------------------------------------------------------------------------- error and cost


def speed_accuracy(rows: pd.DataFrame) -> pd.DataFrame:
    """Return errors and costs; ``pareto`` is True where no other ok row of the problem is both faster and more accurate."""
    results = ["rmse_rel", "bias_rel", "time_s", "time_iqr_s", "compile_s", "rollouts", "gradients"]
    table = rows[["experiment", *IDENTITY, "status", *results]].assign(pareto=False)
    good = table[(table["status"] == "ok") & np.isfinite(table["rmse_rel"]) & np.isfinite(table["time_s"])]
    errors = pd.Series(shown_rmse(rows)[0], rows.index)
    for _, part in good.groupby(number_problems(rows).loc[good.index]):
        table.loc[part.index[pareto(part["time_s"], errors.loc[part.index])], "pareto"] = True
    return table


# --------------------------------------------------------------------------------------------------- ranking


def ranking(methods: pd.DataFrame, equal: pd.DataFrame) -> Table:
    """Return the ranking: a line per estimator with the number of settings by verdict, and its errors by problem.

    Verdicts are of ``methods`` as measured, errors at equal rollouts. Where a problem was swept, its error is the largest along the axis: the worst case.
    """
    counts = verdicts_by_estimator(methods)
    worst = equal.assign(known=equal["error"].fillna(math.inf)).sort_values("known", kind="stable")
    worst = worst.drop_duplicates(["estimator", "problem"], keep="last")
    shares = worst["verdict"] + np.where(worst["bias_share"] > 0.5, ", biased", "")
    # the number of evaluations per sample is shown above this value
    work = worst["evaluations"].map(" ({:.0f}x)".format).where(worst["evaluations"] > 2.5, "")
    notes = shares.mask(worst["status"] != "ok", worst["status"]).mask(worst["not_comparable"], "not comparable") + work
    ends = {end: worst[f"error{end}"] for end in ("", "_low", "_high", "_is_limit")}
    problems, cells = equal["problem"].unique(), pd.DataFrame(ends | {"_note": notes}).set_axis(worst["estimator"])
    frame = counts.join(_across(cells, worst["problem"], problems, "p")).rename_axis("method").reset_index()
    errors = frame[[f"p{i}" for i in range(len(problems))]]
    frame["worst"] = errors.max(axis=1).where(np.isfinite(errors).all(axis=1))
    frame = frame.sort_values("worst", kind="stable", na_position="last")
    columns = [
        ESTIMATOR,
        *(setting(str(name)) for name in counts),
        *(
            interval(f"p{i}", label=problem, limit=f"p{i}_is_limit", note=f"p{i}_note")
            for i, problem in enumerate(problems)
        ),
    ]
    explained = (
        "Sorted by the worst case. Relative RMSE [95% interval] at equal rollouts; where a problem was swept, the largest along "
        "the axis. At the samples of the experiment, works: the whole interval is below 1; fails: it is above 1, or every estimate is 0; open: it contains 1 or is not known. biased: more "
        "than half of the squared error is bias. (40x): it evaluates 40 costs and gradients per sample, where others take "
        "one or two.",
    )
    return Table("ranking", frame, columns, "estimators by their worst case", explained)


def _values(axis: str, at: pd.Series) -> str:
    """Return the values of an axis, ``stiffness 10, 100``; empty without an axis."""
    return f"{axis} {', '.join(map(axis_value, sorted(at.unique())))}" if axis else ""


def _errors(methods: pd.DataFrame) -> str:
    """Return the smallest and largest error; ``< 0.12`` if some are upper limits, ``-`` without any."""
    known = span(*methods["error"].agg(["min", "max"]))
    return f"< {number(methods['error'].max())}" if methods["error_is_limit"].any() else known


def _failing(methods: pd.DataFrame) -> Any:
    """Return the names of what fails somewhere: an estimator's, where it does so on all backends."""
    somewhere = methods.groupby("method")["failed"].transform("any")
    everywhere = somewhere.groupby(methods["estimator"]).transform("all")
    return methods["estimator"].where(everywhere, methods["method"])[somewhere].unique()


def recommendations(methods: pd.DataFrame) -> Table:
    """Return what to use where: a line per problem and range of its axis with the same first and tied estimators that work.

    A method works if its interval is below 1 at equal rollouts, unless it fails as measured.
    """
    methods = methods.assign(failed=methods["verdict"].isin((FAILS, NO_RESULT)))
    now = verdict(methods["status"], *(methods[name] for name in ERROR))
    good = methods[(now == WORKS) & ~methods["failed"]]
    use = methods["setting"].map(compare_errors(good).set_index("setting")["leaders"]).astype(object)
    is_lost = methods.groupby("setting")["failed"].transform("all")
    missing = is_lost.map({True: ("none works",), False: ("none is known to work",)})
    lines = [
        {
            "problem": problem,
            "where": _values(axis, part["at"]),
            "use": " or ".join(use),
            "error": _errors(part[part["method"] == use[0]]),
            "fails": ", ".join(_failing(part)) or "none",
        }
        for (problem, axis, use), part in methods.assign(use=use.fillna(missing)).groupby(
            ["problem", "axis", "use"], sort=False
        )
    ]
    columns = [
        text("problem"),
        text("where"),
        text("use"),
        text("error", label="relative RMSE"),
        text("fails", label="fails there"),
    ]
    notes = ["Errors are compared at equal rollouts, among methods whose interval is below 1."]
    return Table("recommendations", pd.DataFrame(lines), columns, "What to use where", notes, files=(), page=True)
