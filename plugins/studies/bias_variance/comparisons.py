"""Compares estimators at each setting, with intervals: the one table behind ranking, charts and page.

A setting is a problem at one value of its swept axis. A method is an estimator, on the backends that agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis
from bench.experiment.columns import Column, interval, text
from bench.report.problems import ProblemRows, split_by_problem
from bench.report.views import CATEGORIES, Arranged, Curve, attempted, estimator_curves, rmse_interval

WORKS, FAILS, OPEN, NO_RESULT = "works", "fails", "open", "no result"
"""Verdicts of a method at a setting: its interval is below 1, above 1, contains 1 or is not known; it has no number."""
NEAR = 2.0
"""A method whose error is more than this many times the lowest does not share the first place: the order is open."""
EQUAL_SAMPLES, EQUAL_ROLLOUTS = "relative RMSE at equal samples", "relative RMSE at equal rollouts"
COLUMNS = (
    text("problem", "what distinguishes the problem from the others"),
    text("axis", "the swept quantity along which the problem is reported"),
    Column("at", "its value", format="setting"),
    text("basis", "what is compared: the error at equal samples or rollouts, or the cost of reaching an error"),
    text("first", "the method with the lowest value"),
    interval("value", "its value"),
    text("second", "the next method, of another estimator where there is one"),
    interval("factor", "the second value over the first"),
    text("tied", "methods that are not distinguishable from the first"),
)
"""The columns of the table of comparisons."""
VALUE, FACTOR = ([f"{name}{end}" for end in ("", "_low", "_high")] for name in ("value", "factor"))


def problems_by_axis(shown: Arranged) -> list[tuple[Axis | None, ProblemRows]]:
    """Return the problems to report, each with the longest axis along which it was swept.

    Every cell that ran is in at least one problem. The axis is None for cells that no axis sweeps.
    """
    swept = shown.swept()
    parts: list[tuple[Axis | None, ProblemRows]] = []
    seen: set[str] = set()
    for axis in (*sorted(swept, key=lambda a: -swept[a]), None):
        for group in split_by_problem(shown, axis, ("scene", "contact")):
            cells = attempted(group.rows)
            if set(cells["key"]) - seen and (axis is None or cells["x"].nunique() > 1):
                seen |= set(cells["key"])
                parts.append((axis, group))
    return parts


def method_names(curves: Sequence[Curve]) -> list[str]:
    """Return a name per curve: the estimator, and its backends where an estimator has several curves."""
    labels = [curve.label for curve in curves]
    return [
        curve.label if labels.count(curve.label) == 1 else f"{curve.label} ({', '.join(curve.backends)})"
        for curve in curves
    ]


def method_table(shown: Arranged) -> pd.DataFrame:
    """Return a line per setting and method: its relative RMSE with a 95% interval, its verdict, and its cost.

    The column ``setting`` identifies a setting. Along samples, estimators that use costs only, of which some take more
    rollouts per sample than others, are compared at the numbers of rollouts that all have, if there are any.
    """
    lines = []
    for axis, problem in problems_by_axis(shown):
        axis, problem = _at_equal_rollouts(axis, problem)
        curves = estimator_curves(problem.rows)
        along_samples = axis is not None and axis.column == "samples"
        kinds = {name: str(problem.rows[name].iloc[0]).partition("[")[0] for name in CATEGORIES}
        for curve, name in zip(curves, method_names(curves), strict=True):
            for x, row in curve.at.items():
                low, high = (float(end) for end in rmse_interval(row))
                error = float(row["rmse_rel"]) if row["status"] == "ok" else math.nan
                lines.append({
                    "setting": f"{problem.title()}; {axis.column} {x!r}" if axis else problem.title(),
                    "problem": problem.title(), **kinds, "axis": axis.column if axis else "", "at": x if axis else math.nan,
                    "method": name, "estimator": curve.label, "error": error, "error_low": low, "error_high": high,
                    "verdict": verdict(row["status"], error, low, high), "status": row["status"],
                    "remark": row["reason"], "bias_share": (row["bias_low"] / row["rmse"]) ** 2 if error > 0 else math.nan,
                    "evaluations": (row["rollouts"] + row["gradients"]) / (x if along_samples else row["samples"]),
                    "time_s": curve.seconds,
                })  # fmt: skip
    return pd.DataFrame(lines)


ROLLOUTS = Axis("rollouts", ("rollouts",))


def _at_equal_rollouts(axis: Axis | None, problem: ProblemRows) -> tuple[Axis | None, ProblemRows]:
    """Return a problem along its rollouts instead of samples where that is needed and possible."""
    rows = attempted(problem.rows)
    # the rollout at w = 0 is shared by all repeats, a fraction of a rollout each
    spent = rows["rollouts"].round()
    per_sample = (spent / rows["x"]).groupby(rows["estimator"] + rows["estimator_params"]).median()
    if axis is None or axis.column != "samples" or (rows["gradients"] > 0).any() or not per_sample.nunique() > 1:
        return axis, problem
    methods = rows["estimator"] + rows["estimator_params"]
    shared = methods.groupby(spent).nunique()
    kept = spent.isin(shared.index[shared == methods.nunique()])
    if not kept.any():
        return axis, problem
    return ROLLOUTS, replace(problem, rows=rows[kept].assign(x=spent[kept]))


def verdict(status: str, error: float, low: float, high: float) -> str:
    """Return the verdict on an error with its 95% interval. A missing number or interval is never a pass."""
    if status != "ok":
        return NO_RESULT
    if not all(map(math.isfinite, (error, low))) or math.isnan(high):
        return OPEN
    return FAILS if low > 1 else WORKS if high < 1 else OPEN


def ratio(first: Any, second: Any) -> tuple[float, float, float]:
    """Return second over first with a 95% interval; each is a value with the ends of its own interval.

    The interval combines the distances to the ends as independent errors of the logarithms: the method of variance
    estimates recovery, Zou and Donner, Statistics in Medicine 27 (2008), equation 7 for log ratios.
    """
    (a, a_low, a_high), (b, b_low, b_high) = first, second
    if not (a > 0 and b > 0):
        return math.nan, math.nan, math.nan
    with np.errstate(all="ignore"):
        down = np.hypot(np.log(np.divide(b, b_low)), np.log(np.divide(a_high, a)))
        up = np.hypot(np.log(np.divide(b_high, b)), np.log(np.divide(a, a_low)))
    factor = b / a
    return factor, float(factor * np.exp(-down)), float(factor * np.exp(up))


def compare_errors(methods: pd.DataFrame) -> pd.DataFrame:
    """Return a line per setting: the method of lowest error, the next estimator, their factor, and ties.

    Methods whose error is not known, or whose interval is not, cannot be first. A method is tied with the first unless
    the interval of their factor lies above 1.
    """
    lines = []
    for _, part in methods.groupby("setting", sort=False):
        good = part[np.isfinite(part["error"]) & np.isfinite(part["error_low"])].sort_values("error", kind="stable")
        line = part.iloc[0][["setting", "problem", "axis", "at"]].to_dict() | {"first": "", "second": "", "tied": ()}
        line["basis"] = EQUAL_ROLLOUTS if line["axis"] == ROLLOUTS.column else EQUAL_SAMPLES
        if len(good):
            first, *others = good.to_dict("records")
            factors = [(other, ratio(_interval(first), _interval(other))) for other in others]
            line |= {"first": first["method"]} | dict(zip(VALUE, _interval(first), strict=True))
            rivals = [item for item in factors if item[0]["estimator"] != first["estimator"]] or factors
            if rivals:
                line |= {"second": rivals[0][0]["method"]} | dict(zip(FACTOR, rivals[0][1], strict=True))
            line["tied"] = tuple(other["method"] for other, (_, low, _) in factors if not low > 1)
        lines.append(line)
    names = [name for c in COLUMNS for name in (c.name, c.low, c.high) if name]
    return pd.DataFrame(lines, columns=["setting", *names]).astype(dict.fromkeys([*VALUE, *FACTOR], float))


def _interval(row: Any) -> tuple[float, float, float]:
    return float(row["error"]), float(row["error_low"]), float(row["error_high"])


def leaders(comparisons: pd.DataFrame, methods: pd.DataFrame) -> dict[str, list[str]]:
    """Return, per setting, the estimators that are first, or tied and near the first; empty if no error is known."""
    places = zip(methods["setting"], methods["method"], strict=True)
    known = dict(zip(places, zip(methods["estimator"], methods["error"], strict=True), strict=True))
    result = {}
    for row in comparisons[["setting", "first", "value", "tied"]].to_dict("records"):
        lines = [known[row["setting"], name] for name in (row["first"], *row["tied"]) if name]
        near = [estimator for estimator, error in lines if not error > NEAR * row["value"]]
        result[row["setting"]] = list(dict.fromkeys(near))
    return result


def verdicts_by_estimator(methods: pd.DataFrame) -> pd.DataFrame:
    """Return the number of settings per estimator and verdict; an estimator with several methods has the worst of them."""
    order = [WORKS, OPEN, FAILS, NO_RESULT]
    ranks = methods.assign(rank=methods["verdict"].map(order.index))
    worst = ranks.groupby(["estimator", "setting"], sort=False)["rank"].max()
    counts = worst.groupby(level="estimator", sort=False).value_counts().unstack(fill_value=0)
    return counts.rename(columns=dict(enumerate(order))).reindex(columns=order, fill_value=0)
