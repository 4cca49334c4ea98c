"""The cost of an estimate: seconds on this machine, or rollouts on any machine."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis
from bench.experiment.columns import Column, interval, setting, text
from bench.experiment.parameters import OWN_COLUMNS, PROBLEM
from bench.experiment.views import Table
from bench.measure.statistics import ends, is_unexplained
from bench.model import registry
from bench.report.problems import ProblemRows, split_by_problem
from bench.report.text import axis_value, number, short_duration
from bench.report.views import Arranged, estimator_curves, shown_rmse

TIME, ROLLOUTS = "time_s", "rollouts_"
"""Columns with the costs of an estimate: seconds, and rollouts with a gradient at its measured cost."""


def with_gradient_cost(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the column :data:`ROLLOUTS`: a gradient counts as the rollouts that take as long, as one if not measured.

    The ratio is seconds per gradient over seconds per rollout, per program and backend, from the fastest row that uses only
    gradients and the fastest that uses only rollouts, at the largest number of samples with both.
    """
    program = rows.groupby(
        [name for name in (*PROBLEM, *OWN_COLUMNS, "backend") if name in rows], dropna=False
    ).ngroup()
    known = rows[(rows["status"] == "ok") & (rows["time_s"] > 0)]
    gradients, rollouts = known["gradients"], known["rollouts"]

    def least(seconds: pd.Series) -> pd.Series:
        return seconds.groupby([program, rows["samples"]]).min()

    is_batch = gradients + rollouts >= known["samples"]  # one call for few takes as long
    first = least((known["time_s"] / gradients)[is_batch & (rollouts <= 0.01 * gradients)])
    zeroth = least((known["time_s"] / rollouts)[is_batch & (gradients == 0)])
    ratios = (first / zeroth).dropna().sort_index().groupby(level=0).last()
    ratio = program.map(ratios).astype(float).fillna(1.0)
    return rows.assign(**{ROLLOUTS: rows["rollouts"] + ratio * rows["gradients"]})


def with_known(rows: pd.DataFrame, cost: str) -> pd.DataFrame:
    """Return the rows that are ok and have a finite positive error and cost."""
    values = rows[[cost, "rmse_rel"]].astype(float)
    return rows[(rows["status"] == "ok") & (np.isfinite(values) & (values > 0)).all(axis=1)]


SAMPLES = Axis("samples", ("samples",))
COSTS = {"time": TIME, "rollouts": ROLLOUTS}
TEXTS: dict[str, Callable[[float], str]] = {"time": short_duration, "rollouts": axis_value}
SMALLEST_ERROR = 1e-200
"""Errors below this count as this much, since costs are interpolated in logarithms: identical estimates may have none."""
TARGETS = (0.1, 0.01)
"""Target relative errors."""
NOTES = (
    "cost: of the cheapest estimate that reaches the error, in seconds without compilation, or in rollouts, where a "
    "gradient counts as the rollouts that take as long (as measured at the most samples; as one where it was not). how: "
    "`measured` between two sample counts, `at once` where the fewest samples already suffice (the cost is an upper "
    "limit), `extrapolated` by RMSE^2 = bias^2 + v / N beyond the most samples measured, where the 95% limit of the bias "
    "lies below the error asked for and samples are independent. fastest: the cheapest of known cost. factor: `at least` where the first suffices with the fewest "
    "samples, or the next is not known and its lower limit decides: the cost of the most samples measured, or "
    "of an unbiased estimate for independent samples. never: methods whose bias exceeds that "
    "error. unknown: methods whose bias is not known to be below it, or is one that they declare not to have, and methods that "
    "choose samples together or fit a model to them, whose error beyond the most samples is not known.",
)


@dataclass(frozen=True)
class RequiredCost:
    """The cost of a method to reach an error, or the reason why it is unknown."""

    how: str
    """``measured``, ``at once``, ``extrapolated``, ``never`` or ``unknown``."""
    cost: float = math.nan
    samples: float = math.nan
    down: float = 0.0
    """Log of cost over the lower end of its 95% interval; infinite where the variance has no interval."""
    up: float = 0.0
    """Log of the upper end over the cost; infinite where it is not certain that the error is reached."""
    beyond: float = math.inf
    """A cost that is not known exceeds this one: that of the most samples measured, or that of an estimate without bias.
    Infinite without any result."""
    times: float = 0.0
    """Interquartile range of the time of one estimate over its median; 0 for rollouts."""


def required_cost(curve: pd.DataFrame, target: float, cost: str) -> RequiredCost:
    """Return the cost of an estimator on a backend to reach a relative RMSE of ``target``, with its 95% interval."""
    rows = with_known(curve.assign(rmse_rel=shown_rmse(curve)[0]), cost).sort_values("x")
    if rows.empty:
        return RequiredCost("unknown")
    way, low, high = (
        _required_cost(at, target, cost) for at in (rows, *(_at_interval_end(rows, end) for end in ("low", "high")))
    )
    times = float((rows["time_iqr_s"] / rows["time_s"]).iloc[-1]) if cost == TIME else 0.0
    if not math.isfinite(way.cost):
        return replace(way, beyond=low.cost if math.isfinite(low.cost) else low.beyond, times=times)
    # fewer samples than the fewest may be enough, down to one
    least = _cost_of_one_sample(rows, cost) if way.how == "at once" else low.cost
    down = max(0.0, math.log(way.cost / least)) if least > 0 else math.inf
    up = max(0.0, math.log(high.cost / way.cost)) if math.isfinite(high.cost) else math.inf
    return replace(way, down=down, up=up, times=times)


def declares(rows: pd.DataFrame, fact: str) -> pd.Series:
    """Return whether the estimator of each row, with its defaults, declares a fact, such as ``fixed_work``."""
    names = {name for name, entry in registry.entries()["estimators"].items() if entry.plugin}
    declared = {
        name: bool(getattr(registry.make("estimators", name), fact, False)) for name in names & {*rows["estimator"]}
    }
    return rows["estimator"].map(declared).eq(True)


def couples_samples(rows: pd.DataFrame) -> pd.Series:
    """Return whether the samples of each row's estimates are chosen together, so that v / N need not hold."""
    return (rows["draws"] != "iid") | declares(rows, "couples_samples")


def _cost_of_one_sample(rows: pd.DataFrame, cost: str) -> float:
    """Return the cost of an estimate from one sample, extrapolated linearly from the two smallest sample counts."""
    n, price = rows[["x", cost]].to_numpy(float)[:2].T
    slope = (price[1] - price[0]) / (n[1] - n[0]) if len(n) > 1 else price[0] / n[0]
    return float(np.clip(price[0] - slope * (n[0] - 1.0), price[0] / n[0], price[0]))


def _at_interval_end(rows: pd.DataFrame, end: str) -> pd.DataFrame:
    """Return rows with variance and bias at an end of their 95% intervals; the bias is 0 unless distinguishable from 0."""
    bias = rows[f"bias_{end}"].where(rows["bias_low"] > 0, 0.0)
    error = np.hypot(bias, np.sqrt(rows[f"variance_{end}"])) / rows["reference_norm"]
    return rows.assign(bias=bias, variance=rows[f"variance_{end}"], rmse_rel=np.maximum(error, SMALLEST_ERROR))


def lead(first: RequiredCost, second: RequiredCost) -> tuple[float, float, float]:
    """Return the ratio of the second cost to the first, and the ends of its 95% interval.

    Where only a lower limit is known, the ratio is NaN and the upper end infinite.
    """
    is_known, noise = math.isfinite(second.cost), (first.times, second.times)
    factor = (second.cost if is_known else second.beyond) / first.cost
    low = factor * math.exp(-math.hypot(first.up, second.down, *noise))
    if not is_known or (first.how == "at once" and first.down > 0):
        return math.nan, low, math.inf
    return factor, low, factor * math.exp(math.hypot(first.down, second.up, *noise))


def _required_cost(rows: pd.DataFrame, target: float, cost: str) -> RequiredCost:
    n, error, price = rows[["x", "rmse_rel", cost]].to_numpy(float).T
    if not (error <= target).any():
        work = rows["rollouts"] + rows["gradients"]
        has_no_law = bool(couples_samples(rows).iloc[-1]) or work.nunique() == 1 < len(rows)
        return _extrapolated_cost(rows.iloc[-1], price[-1], target, has_no_law)
    # more samples may cost less: the fixed cost of a call dominates small batches
    ways = [RequiredCost("measured" if i else "at once", price[i], n[i]) for i in np.flatnonzero(error <= target)]
    for i in range(1, len(n)):
        if error[i] <= target < error[i - 1]:
            share = math.log(error[i - 1] / target) / math.log(error[i - 1] / error[i])
            samples, needed = (math.exp((1 - share) * math.log(v[i - 1]) + share * math.log(v[i])) for v in (n, price))
            ways.append(RequiredCost("measured", needed, samples))
    return min(ways, key=lambda way: (way.cost, way.samples))


def _extrapolated_cost(row: Any, price: float, target: float, has_no_law: bool) -> RequiredCost:
    """Extrapolate the cost from the row with most samples: v is N times its variance, and cost is proportional to N.

    It ``has_no_law`` where samples are coupled or the work is the same for all N.
    """
    low, high, bias = (row[name] / row["reference_norm"] for name in ("bias_low", "bias_high", "bias"))
    # an estimator without declared bias may only have heavy tails that the samples missed
    if low >= target and not is_unexplained(str(row.get("reason", ""))):
        return RequiredCost("never")
    samples, is_known = row["x"], not has_no_law and high < target
    certain_bias = bias if is_known and low > 0 else 0.0
    needed = samples * row["variance"] / row["reference_norm"] ** 2 / (target**2 - certain_bias**2)
    factor = 1.0 if has_no_law else max(needed / samples, 1.0)
    if not is_known:
        return RequiredCost("unknown", beyond=price * factor)
    return RequiredCost("extrapolated", price * factor, samples * factor)


def table(shown: Arranged) -> pd.DataFrame:
    """Return a line per problem, kind of cost and target error; empty if samples were not swept."""
    if shown.rows["samples"].nunique() < 2:
        return pd.DataFrame()
    kinds = ["rollouts"] if shown.rows["time_s"].isna().all() else [*COSTS]
    entries = [
        line(problem, target, kind)
        for problem in split_by_problem(shown, SAMPLES, ("scene",))
        if problem.rows["x"].nunique() > 1
        for kind in kinds
        for target in TARGETS
    ]
    return pd.DataFrame(entries)


def methods_by_cost(problem: ProblemRows, target: float, cost: str) -> dict[str, RequiredCost]:
    """Return each method's cost to reach an error. For time a method is an estimator on a backend, else an estimator."""
    curves = estimator_curves(problem.rows, close=None)
    names = curves["label"] + (" on " + curves["backend"] if cost == TIME else "")
    costs = [
        (name, required_cost(curve, target, cost)) for (name, _), curve in curves.groupby([names, "curve"], sort=False)
    ]
    return {name: min((needed for other, needed in costs if other == name), key=order) for name, _ in costs}


def order(needed: RequiredCost) -> tuple[float, float, bool]:
    """Return a key that sorts known costs first, then those known to exceed the least, and failed methods last."""
    return needed.cost if math.isfinite(needed.cost) else math.inf, needed.beyond, needed.how == "unknown"


def estimator_of(method: str) -> str:
    """Return the estimator of a method: ``fobg`` of ``fobg on jax``."""
    return method.partition(" on ")[0]


def line(problem: ProblemRows, target: float, kind: str) -> dict[str, Any]:
    """Return a line of the table: the cheapest method, the next of another estimator, and excluded ones."""
    reached = methods_by_cost(problem, target, COSTS[kind]) or {"-": RequiredCost("never")}
    first = min(reached, key=lambda name: (order(reached[name])[0], name))
    best, by_how = (
        reached[first],
        {how: [n for n, r in reached.items() if r.how == how] for how in ("never", "unknown")},
    )
    entry = {"problem": problem.title(), "relative error": target, "by": kind, "fastest": first, "cost": best.cost}
    if math.isfinite(best.cost):
        entry |= {"samples": math.ceil(best.samples), "how": best.how}
    else:
        entry |= {"fastest": "-", "samples": math.nan, "how": "not known" if by_how["unknown"] else "never"}
    return entry | _following(first, reached) | {how: ", ".join(names) or "-" for how, names in by_how.items()}


def _following(first: str, reached: dict[str, RequiredCost]) -> dict[str, Any]:
    """Return the next method of another estimator than the first, their factor, and all that may be as cheap.

    A method whose cost is not known is the next if it may be cheaper than the next of known cost.
    """
    leads = {
        name: lead(reached[first], needed)
        for name, needed in sorted(reached.items(), key=lambda item: order(item[1])[0])
        if math.isfinite(reached[first].cost)
        and needed.how != "never"
        and min(order(needed)[:2]) < math.inf
        and estimator_of(name) != estimator_of(first)
    }
    least = {name: low if math.isnan(factor) else factor for name, (factor, low, _) in leads.items()}
    following = min(leads, key=least.__getitem__, default="-")
    factor = ends("factor", leads.get(following, (math.nan,) * 3))
    return {"next": following, **factor, "tied": tuple(n for n, (_, low, _) in leads.items() if not low > 1.0)}


def accuracy_table(best: pd.DataFrame) -> Table:
    """Return the table of :func:`table` for readers."""
    costs = [
        TEXTS[kind](float(number(cost))) if math.isfinite(cost) else "-"
        for kind, cost in zip(best["by"], best["cost"], strict=True)
    ]
    columns = [
        text("problem"),
        Column("relative error", format="percent"),
        text("by"),
        text("fastest"),
        text("cost_text", label="cost"),
        setting("samples"),
        text("how"),
        text("next"),
        interval("factor", note="factor_note"),
        text("never"),
        text("unknown"),
    ]
    return Table(
        "time_to_accuracy",
        best.assign(cost_text=costs, factor_note=limits(best)),
        columns,
        "the method that reaches an error at the lowest cost",
        NOTES,
        terminal=True,
        details=("never", "unknown"),
        data=best.assign(tied=[", ".join(names) for names in best["tied"]]),
    )


def limits(table: pd.DataFrame) -> list[str]:
    """Return the words for each factor without a value: ``at least 2.4``, or ``not known`` where the limit is below 1."""
    factors = zip(table["factor"], table["factor_low"], table["factor_high"], strict=True)
    return [
        "" if not (math.isnan(factor) and high == math.inf) else f"at least {number(low)}" if low > 1.0 else "not known"
        for factor, low, high in factors
    ]
