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
from bench.experiment.columns import Column, interval, setting, text
from bench.measure import statistics
from bench.report.problems import ProblemRows, split_by_problem
from bench.report.views import CATEGORIES, Arranged, attempted, estimator_curves, shown_rmse

from .time_to_accuracy import ROLLOUTS, couples_samples, declares

WORKS, FAILS, OPEN, NO_RESULT = "works", "fails", "open", "no result"
"""Verdicts of a method at a setting: its interval is below 1; above 1, or every estimate is 0; contains 1 or is not known; it
has no number."""
SAME_COST = 1.05
"""Costs within this factor count as equal: a call at w = 0 that all samples share makes 101 rollouts of 100."""
LAW = (
    "bias",
    "bias_low",
    "bias_high",
    "variance",
    "variance_low",
    "variance_high",
    "reference_norm",
    "reference_se",
    "rmse_rel",
)
"""Columns from which the error at other numbers of samples follows: RMSE^2 = bias^2 + v / N."""
COMPARED = (
    text("problem", "what distinguishes the problem from the others"),
    text("axis", "the swept quantity along which the problem is reported"),
    setting("at", "its value"),
    Column(
        "rollouts",
        "rollouts of one estimate at which errors are compared; a gradient counts as the rollouts that take as long",
        digits=3,
    ),
    text("first", "the method with the lowest value"),
    interval("value", "its value"),
    text("second", "the next method, of another estimator where there is one"),
    interval("factor", "the second value over the first"),
    text(
        "tied", "methods that are not distinguishable from the first, or lower where only their upper limits are known"
    ),
    text("not_comparable", "methods whose error at these rollouts is not known"),
)
"""The columns of the table of comparisons."""
SETTING = ["setting", "problem", "axis", "at", "rollouts"]
Problems = list[tuple[Axis | None, ProblemRows]]
"""Problems as curves, each with the axis along which it is reported."""
ERROR, VALUE, FACTOR = ([f"{name}{end}" for end in ("", "_low", "_high")] for name in ("error", "value", "factor"))


def problems_by_axis(shown: Arranged) -> Problems:
    """Return the problems to report as curves, each with the longest axis along which it was swept.

    Every cell that ran is in at least one problem. The axis is None for cells that no axis sweeps.
    """
    swept = shown.swept()
    parts: Problems = []
    seen: set[str] = set()
    for axis in (*sorted(swept, key=lambda a: -swept[a]), None):
        for group in split_by_problem(shown, axis, ("scene", "contact")):
            cells = attempted(group.rows)
            if set(cells["key"]) - seen and (axis is None or cells["x"].nunique() > 1):
                seen |= set(cells["key"])
                parts.append((axis, replace(group, rows=estimator_curves(group.rows))))
    return parts


def method_table(problems: Problems) -> pd.DataFrame:
    """Return a line per setting and method: its relative RMSE as measured with a 95% interval, its verdict, and its cost.

    The column ``setting`` identifies a setting. ``rollouts`` is the cost of one estimate, a gradient as the rollouts that
    take as long.
    """
    parts = [pd.DataFrame()]
    for axis, problem in problems:
        rows, along = problem.rows, axis.column if axis else ""
        error, low, high, is_limit = shown_rmse(rows)
        samples = rows["x"] if along == "samples" else rows["samples"]
        parts.append(
            pd.DataFrame(
                {
                    "setting": setting_names(problem, axis, rows),
                    "problem": problem.title(),
                    **{name: str(rows[name].iloc[0]).partition("[")[0] for name in CATEGORIES},
                    "axis": along,
                    "at": rows["x"] if axis else math.nan,
                    "method": rows["method"],
                    "estimator": rows["label"],
                    "error": error,
                    "error_low": low,
                    "error_high": high,
                    "error_is_limit": is_limit,
                    "verdict": verdict(
                        rows["status"], error, low, high, (rows["grad_norm"] == 0) & (rows["variance"] == 0)
                    ),
                    "status": rows["status"],
                    "remark": rows["reason"],
                    "trusted": rows.get("trusted", ""),
                    "bias_share": ((rows["bias_low"] / rows["rmse"]) ** 2).where(error > 0),
                    "evaluations": (rows["rollouts"] + rows["gradients"]) / samples,
                    "time_s": rows["seconds"],
                    "rollouts": rows[ROLLOUTS],
                    "has_law": has_law(rows),
                    "has_fixed_work": declares(rows, "fixed_work"),
                    "is_fitted": declares(rows, "couples_samples"),
                    **{name: rows[name] for name in LAW},
                }
            )
        )
    return pd.concat(parts, ignore_index=True)


def setting_names(problem: ProblemRows, axis: Axis | None, rows: pd.DataFrame) -> pd.Series:
    """Return the name of the setting of each row of a problem along an axis."""
    return f"{problem.title()}; {axis.column if axis else ''} " + rows["x"].astype(str)


def has_law(rows: pd.DataFrame) -> pd.Series:
    """Return whether the error of each row at other numbers of samples is known: they are independent, and the bias constant.

    A bias is constant where an estimate is a mean of terms. Weights that depend on all samples change it with their number.
    """
    # ``separable`` is of sample means
    is_constant = declares(rows, "separable") | declares(rows, "unbiased")
    return ~couples_samples(rows) & is_constant & ~declares(rows, "fixed_work")


def at_equal_rollouts(methods: pd.DataFrame) -> pd.DataFrame:
    """Return the methods with their errors at equal rollouts: in each setting those at which most methods are known.

    A method has the error of its row with as many rollouts. Without one it has that of its nearest row by RMSE^2 = bias^2 +
    v / N. Where that law does not hold, it has the error of a row with fewer rollouts, which are allowed too: with more of
    them it might be lower, so its interval begins lower. If there is none, ``not_comparable`` is true. The rollouts are the
    fewest at which most methods are known, and not fewer than the samples of any method take; along samples a setting is a
    number of rollouts, and they are the most.
    """
    parts = [methods.assign(scale=1.0, share=1.0)[:0]]
    for _, level in methods.groupby("setting", sort=False):
        along, problem = level[["axis", "problem"]].iloc[0]
        is_swept = along == "samples"
        of = methods[(methods["axis"] == along) & (methods["problem"] == problem)] if is_swept else level
        found = _at_common_rollouts(level, of, is_swept)
        if is_swept:
            cost = found["rollouts"].iloc[0]
            found = found.assign(setting=f"{problem}; rollouts {cost:.3g}", axis="rollouts", at=float(f"{cost:.3g}"))
        parts.append(found)
    found = pd.concat(parts).drop_duplicates(["setting", "method"], ignore_index=True)
    found = _scaled(found, found.pop("scale"))
    share = found.pop("share").where(~found["has_law"] & ~found["has_fixed_work"]).clip(upper=1.0)
    # without a law an error may fall with the rollouts as N^-2 at most: for a Sobol set and a smooth cost it falls as N^-1.5.
    # A fitted model may become exact
    found["error_low"] *= (share**2.0).fillna(1.0).mask(found["is_fitted"] & (share < 1.0), 0.0)
    return found


def _at_common_rollouts(level: pd.DataFrame, of: pd.DataFrame, prefers_most: bool) -> pd.DataFrame:
    """Return the row of each method that is nearest to the rollouts at which most methods of a ``level`` are known.

    The row is one ``of`` the problem's rows. ``share`` are its rollouts over these, and ``scale`` is the factor on its variance:
    1 where it is known as measured, NaN where its error is not known.
    """
    least = level["rollouts"][~level["has_fixed_work"]].min()
    costs = level["rollouts"][(level["rollouts"] > 0) & ~(level["rollouts"] < least)].unique()
    if not costs.size:
        return level.assign(rollouts=math.nan, scale=math.nan, share=math.nan)
    spent, has_law = of["rollouts"].where(of["rollouts"] > 0), of["has_law"].astype(bool)

    def distance(cost: float) -> pd.Series:
        """Return how far each row is from some rollouts, as a logarithm; infinite where its error says nothing there."""
        return np.log(spent / cost).abs().where(has_law | (spent <= SAME_COST * cost), math.inf)

    def is_measured(cost: float) -> pd.Series:
        """Return whether a row has these rollouts or, where no law gives its error at others, fewer."""
        return (distance(cost) <= math.log(SAME_COST)) | (~has_law & (spent <= cost))

    def n_known(cost: float) -> int:
        return int(of["method"][is_measured(cost) | has_law].nunique())

    cost = max(costs, key=lambda cost: (n_known(cost), cost if prefers_most else -cost))
    nearest = distance(cost).fillna(math.inf).groupby(of["method"], sort=False).idxmin()
    scale = (spent / cost).where(has_law).mask(is_measured(cost), 1.0)
    return of.loc[nearest].assign(rollouts=cost, scale=scale, share=spent / cost)


def _scaled(methods: pd.DataFrame, scale: pd.Series) -> pd.DataFrame:
    """Return methods with the errors of variances ``scale`` times as large, or without errors where that is NaN."""
    changed = methods.assign(**{name: methods[name] * scale for name in LAW if name.startswith("variance")})
    error = statistics.rmse(changed["bias"], changed["variance"]) / changed["reference_norm"]
    changed["rmse_rel"] = methods["rmse_rel"].where((scale == 1.0) | methods["rmse_rel"].isna(), error)
    is_ok = methods["status"] == "ok"
    *ends, is_limit = shown_rmse(changed)
    return changed.assign(
        **{n: pd.Series(end, methods.index).where(is_ok & scale.notna()) for n, end in zip(ERROR, ends, strict=True)},
        error_is_limit=is_limit,
        not_comparable=is_ok & scale.isna(),
    )


def lowest(equal: pd.DataFrame) -> set[tuple[str, str]]:
    """Return the settings and methods whose interval at equal rollouts lies below that of every other estimator."""
    return {
        (row.setting, row.method)
        for level in _by_setting(equal[equal["status"] == "ok"])
        for row in level[~level.error_is_limit]
        if len(rivals := level.error_low[level.estimator != row.estimator]) and (rivals > row.error_high).all()
    }


def verdict(status: Any, error: Any, low: Any, high: Any, is_zero: Any = False) -> Any:
    """Return the verdict on each error with its 95% interval. A missing number or interval is never a pass.

    An estimate that ``is_zero`` has the error of the zero estimate, however well the reference is known.
    """
    is_known = np.isfinite(error) & np.isfinite(low) & ~np.isnan(high)
    fails = is_known & ((low > 1) | is_zero)
    return np.select([status != "ok", fails, is_known & (high < 1)], [NO_RESULT, FAILS, WORKS], OPEN)


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
    """Return a line per setting: the method of lowest error, the next estimator, their factor, ties, and leaders.

    Methods whose error is not known, or whose interval is not, cannot be first, nor can those with an upper limit only. A
    method is tied with the first unless the interval of their factor lies above 1. No method is first where upper limits
    of others lie below its interval: these are tied. Nor is one with which no other can be compared. ``leaders`` are the
    first and those tied with it whose error is near.
    """
    names = [*SETTING, "not_comparable", "first", *VALUE, "second", *FACTOR, "tied", "leaders"]
    return pd.DataFrame(map(_compared, _by_setting(methods)), columns=names)


def _by_setting(methods: pd.DataFrame) -> list[np.recarray]:
    """Return the methods at each setting, in order of appearance; all are converted at once, since that is slow."""
    records = methods.to_records()
    return [records[places] for places in methods.groupby("setting", sort=False).indices.values()]


def _compared(level: np.recarray) -> dict[str, Any]:
    """Return the line of the methods at one setting."""
    good = level[np.isfinite(level.error + level.error_low)]
    good = good[np.argsort(good.error, kind="stable")]
    known, missing = good[~good.error_is_limit], tuple(level.method[level.not_comparable])
    lower = good[good.error_is_limit & (good.error < min(known.error_low[:1], default=math.inf))]
    line = {
        **{name: level[name][0] for name in SETTING},
        "not_comparable": missing,
        "first": "",
        "second": "",
        "tied": (),
        "leaders": tuple(lower.method),
    }
    if not len(known) or len(lower) or (missing and len(good) == 1):
        return line | {"tied": line["leaders"]}
    first, others = known[0], good[good.method != known[0].method]
    line |= {"first": first.method, "leaders": (first.method,), **dict(zip(VALUE, first[ERROR], strict=True))}
    if not len(others):
        return line
    factors = np.array(ratio(first[ERROR], [others[name] for name in ERROR]))
    factors[0, others.error_is_limit] = math.nan
    # the next of another estimator, where there is one
    second = int(np.argmax(others.estimator != first.estimator))
    tied = others[~(factors[1] > 1)]
    # a method whose error is more than this many times the lowest does not share the first place: the order is open
    near = tied.method[~(tied.error > 2.0 * first.error)]
    line |= {
        "second": others.method[second],
        "tied": tuple(tied.method),
        "leaders": (first.method, *near),
    }
    return line | dict(zip(FACTOR, factors[:, second], strict=True))


def verdicts_by_estimator(methods: pd.DataFrame) -> pd.DataFrame:
    """Return the number of settings per estimator and verdict; an estimator with several methods has the worst of them."""
    order = [WORKS, OPEN, FAILS, NO_RESULT]
    ranks = methods.assign(rank=methods["verdict"].map(order.index))
    worst = ranks.groupby(["estimator", "setting"], sort=False)["rank"].max()
    counts = worst.groupby(level="estimator", sort=False).value_counts().unstack(fill_value=0)
    return counts.rename(columns=dict(enumerate(order))).reindex(columns=order, fill_value=0)
