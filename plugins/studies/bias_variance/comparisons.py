"""Compares estimators at each setting, with intervals: the one table behind ranking, charts and page.

A setting is a problem at one value of its swept axis. A method is an estimator, on the backends that agree.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis
from bench.experiment.columns import Column, interval, text
from bench.report.problems import ProblemRows, split_by_problem
from bench.report.views import CATEGORIES, Arranged, attempted, estimator_curves, shown_rmse

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
    text(
        "tied", "methods that are not distinguishable from the first, or lower where only their upper limits are known"
    ),
)
"""The columns of the table of comparisons."""
ERROR, VALUE, FACTOR = ([f"{name}{end}" for end in ("", "_low", "_high")] for name in ("error", "value", "factor"))


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


def method_table(shown: Arranged) -> pd.DataFrame:
    """Return a line per setting and method: its relative RMSE with a 95% interval, its verdict, and its cost.

    The column ``setting`` identifies a setting. Along samples, estimators that use costs only, of which some take more
    rollouts per sample than others, are compared at the numbers of rollouts that all have, if there are any.
    """
    parts = [pd.DataFrame()]
    for axis, problem in problems_by_axis(shown):
        axis, problem = _at_equal_rollouts(axis, problem)
        rows, title, along = estimator_curves(problem.rows), problem.title(), axis.column if axis else ""
        error, low, high, is_limit = shown_rmse(rows)
        error = np.where(rows["status"] == "ok", error, math.nan)
        samples = rows["x"] if along == "samples" else rows["samples"]
        kinds = {name: str(problem.rows[name].iloc[0]).partition("[")[0] for name in CATEGORIES}
        parts.append(pd.DataFrame({
            "setting": f"{title}; {along} " + rows["x"].astype(str), "problem": title, **kinds, "axis": along,
            "at": rows["x"] if axis else math.nan, "method": rows["method"], "estimator": rows["label"],
            "error": error, "error_low": low, "error_high": high, "error_is_limit": is_limit,
            "verdict": verdict(rows["status"], error, low, high), "status": rows["status"], "remark": rows["reason"],
            "bias_share": ((rows["bias_low"] / rows["rmse"]) ** 2).where(error > 0),
            "evaluations": (rows["rollouts"] + rows["gradients"]) / samples, "time_s": rows["seconds"],
        }))  # fmt: skip
    return pd.concat(parts, ignore_index=True)


ROLLOUTS = Axis("rollouts", ("rollouts",))


def _at_equal_rollouts(axis: Axis | None, problem: ProblemRows) -> tuple[Axis | None, ProblemRows]:
    """Return a problem along its rollouts instead of samples where that is needed and possible.

    An estimator whose rollouts do not grow with the samples is at each number of rollouts that suffices for it.
    """
    rows = attempted(problem.rows)
    # the rollout at w = 0 is shared by all repeats, a fraction of a rollout each
    rows = rows.assign(spent=rows["rollouts"].round(), by=rows["estimator"] + rows["estimator_params"])
    per_sample = (rows["spent"] / rows["x"]).groupby(rows["by"]).median()
    if axis is None or axis.column != "samples" or (rows["gradients"] > 0).any() or not per_sample.nunique() > 1:
        return axis, problem
    counts = rows.groupby("by")[["x", "spent"]].transform("nunique")
    is_fixed = (counts["x"] > 1) & (counts["spent"] == 1)
    fixed, growing = rows[is_fixed & (rows["x"] == rows["x"].min())], rows[~is_fixed]
    shared = growing.groupby("spent")["by"].nunique()
    budgets = shared.index[shared == growing["by"].nunique()]
    if budgets.empty:
        return axis, problem
    parts = [growing[growing["spent"].isin(budgets)].assign(x=lambda kept: kept["spent"])]
    parts += [fixed[fixed["spent"] <= budget].assign(x=budget) for budget in budgets]
    return ROLLOUTS, replace(problem, rows=pd.concat(parts).drop(columns=["spent", "by"]))


def verdict(status: Any, error: Any, low: Any, high: Any) -> Any:
    """Return the verdict on each error with its 95% interval. A missing number or interval is never a pass."""
    is_known = np.isfinite(error) & np.isfinite(low) & ~np.isnan(high)
    return np.select([status != "ok", is_known & (low > 1), is_known & (high < 1)], [NO_RESULT, FAILS, WORKS], OPEN)


def ratio(first: Any, second: Any) -> tuple[Any, Any, Any]:
    """Return second over first with a 95% interval; each is a value, or values, with the ends of its own interval.

    The interval combines the distances to the ends as independent errors of the logarithms: the method of variance
    estimates recovery, Zou and Donner, Statistics in Medicine 27 (2008), equation 7 for log ratios.
    """
    (a, a_low, a_high), (b, b_low, b_high) = first, second
    with np.errstate(all="ignore"):
        factor = np.where((a > 0) & (b > 0), np.divide(b, a), math.nan)
        down = np.hypot(np.log(np.divide(b, b_low)), np.log(np.divide(a_high, a)))
        up = np.hypot(np.log(np.divide(b_high, b)), np.log(np.divide(a, a_low)))
        return factor, factor * np.exp(-down), factor * np.exp(up)


def compare_errors(methods: pd.DataFrame) -> pd.DataFrame:
    """Return a line per setting: the method of lowest error, the next estimator, their factor, and ties.

    Methods whose error is not known, or whose interval is not, cannot be first, nor can those with an upper limit only. A
    method is tied with the first unless the interval of their factor lies above 1. No method is first where upper limits
    of others lie below its interval: these are tied.
    """
    good = methods[np.isfinite(methods[["error", "error_low"]]).all(axis=1)].sort_values("error", kind="stable")
    lowest = good[~good["error_is_limit"]].drop_duplicates("setting")
    first = lowest.set_index("setting")
    least = good["setting"].map(first["error_low"]).astype(float).fillna(math.inf)
    lower = good[good["error_is_limit"] & (good["error"] < least)]
    first = first[~first.index.isin(lower["setting"])]
    others = good.drop(lowest.index).merge(first, on="setting", suffixes=("", "_of_first"))
    factors = ratio(*([others[f"{end}{of}"] for end in ERROR] for of in ("_of_first", "")))
    factors = (np.where(others["error_is_limit"], math.nan, factors[0]), *factors[1:])
    others = others.assign(
        same=others["estimator"] == others["estimator_of_first"], **dict(zip(FACTOR, factors, strict=True))
    )
    second = others.sort_values("same", kind="stable").drop_duplicates("setting").set_index("setting")
    tied = pd.concat([others[~(others["factor_low"] > 1)], lower]).groupby("setting", sort=False)["method"].agg(tuple)
    lines = methods.drop_duplicates("setting").set_index("setting")[["problem", "axis", "at"]].assign(
        basis=lambda line: np.where(line["axis"] == ROLLOUTS.column, EQUAL_ROLLOUTS, EQUAL_SAMPLES),
        first=first["method"], **{name: first[error] for name, error in zip(VALUE, ERROR, strict=True)},
        second=second["method"], **{name: second[name] for name in FACTOR}, tied=tied,
    )  # fmt: skip
    lines["tied"] = [names if isinstance(names, tuple) else () for names in lines["tied"]]
    return lines.fillna({"first": "", "second": ""}).reset_index()


def leaders(comparisons: pd.DataFrame, methods: pd.DataFrame) -> pd.Series:
    """Return, per setting, the estimators that are first, or tied and near the first; settings without a known error have none."""
    named = comparisons.assign(method=[(line.first, *line.tied) for line in comparisons.itertuples()]).explode("method")
    near = named.merge(methods[["setting", "method", "estimator", "error"]], on=["setting", "method"])
    near = near[~(near["error"] > NEAR * near["value"])].drop_duplicates(["setting", "estimator"])
    return near.groupby("setting", sort=False)["estimator"].agg(tuple)


def verdicts_by_estimator(methods: pd.DataFrame) -> pd.DataFrame:
    """Return the number of settings per estimator and verdict; an estimator with several methods has the worst of them."""
    order = [WORKS, OPEN, FAILS, NO_RESULT]
    ranks = methods.assign(rank=methods["verdict"].map(order.index))
    worst = ranks.groupby(["estimator", "setting"], sort=False)["rank"].max()
    counts = worst.groupby(level="estimator", sort=False).value_counts().unstack(fill_value=0)
    return counts.rename(columns=dict(enumerate(order))).reindex(columns=order, fill_value=0)
