"""Finds the method (estimator and backend) that reaches a relative error at the lowest cost, and its lead over the next.

The mean square error of an estimate from N samples is bias^2 + v / N. Between two measured N the error is interpolated.
Beyond the largest N it is extrapolated by that law, only to errors above the 95% limit of the bias.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis
from bench.experiment.columns import Column, text
from bench.experiment.views import Table
from bench.measure.statistics import is_unexplained
from bench.report.problems import ProblemRows, split_by_problem
from bench.report.text import counted, number
from bench.report.views import Arranged, Curve, estimator_curves
from bench.studies.bias_variance.costs import ROLLOUTS, TIME, Cost

SAMPLES = Axis("samples", ("samples",))
TARGETS = (0.1, 0.01)
"""Target relative errors."""
NOTES = (
    "cost: of the cheapest estimate that reaches the error, in seconds without compilation, or in rollouts, where a "
    "gradient counts as the rollouts that take as long (as measured at the most samples; as one where it was not). how: "
    "`measured` between two sample counts, `at once` where the fewest samples already suffice (the cost is an upper "
    "limit), `extrapolated` by RMSE^2 = bias^2 + v / N beyond the most samples measured, where the 95% limit of the bias "
    "lies below the error asked for. never: methods whose bias exceeds that error. unknown: methods whose bias is not known "
    "to be below it, or is one that they declare not to have.",
)


@dataclass(frozen=True)
class RequiredCost:
    """The cost of a method to reach an error, or the reason why it is unknown."""

    how: str
    """``measured``, ``at once``, ``extrapolated``, ``never`` or ``unknown``."""
    cost: float = math.nan
    samples: float = math.nan
    down: float = math.nan
    """Log of cost over the lower end of its 95% interval; NaN where the variance has no interval."""
    up: float = math.nan
    """Log of the upper end over the cost; infinite where it is not certain that the error is reached."""
    times: float = 0.0
    """Interquartile range of the time of one estimate over its median; 0 for rollouts."""


def required_cost(line: Curve, target: float, cost: Cost) -> RequiredCost:
    """Return the cost of a curve's estimator and backend to reach a relative RMSE of ``target``, with its 95% interval."""
    rows = cost.known(line.rows).sort_index()
    if rows.empty:
        return RequiredCost("unknown")
    way = _required_cost(rows, target, cost)
    last = rows.iloc[-1]
    times = float(last["time_iqr_s"] / last["time_s"]) if cost is not ROLLOUTS else 0.0
    if not math.isfinite(way.cost) or "variance_high" not in rows:
        return replace(way, times=times)
    least, most = (_required_cost(_at_interval_end(rows, end), target, cost).cost for end in ("low", "high"))
    if way.how == "at once":  # fewer samples may be enough, down to one
        least = _cost_of_one_sample(rows, cost)
    down = max(0.0, math.log(way.cost / least)) if least > 0 else math.inf
    up = max(0.0, math.log(most / way.cost)) if math.isfinite(most) else math.inf
    return replace(way, down=down, up=up, times=times)


def _cost_of_one_sample(rows: pd.DataFrame, cost: Cost) -> float:
    """Return the cost of an estimate from one sample, extrapolated linearly from the two smallest sample counts."""
    n, price = rows.index.to_numpy(float)[:2], cost.of(rows).to_numpy(float)[:2]
    slope = (price[1] - price[0]) / (n[1] - n[0]) if len(n) > 1 else price[0] / n[0]
    return float(np.clip(price[0] - slope * (n[0] - 1.0), price[0] / n[0], price[0]))


def _at_interval_end(rows: pd.DataFrame, end: str) -> pd.DataFrame:
    """Return rows with variance and bias at an end of their 95% intervals; the bias is 0 unless distinguishable from 0."""
    bias = rows[f"bias_{end}"].where(rows["bias_low"] > 0, 0.0)
    error = np.hypot(bias, np.sqrt(rows[f"variance_{end}"])) / rows["reference_norm"]
    return rows.assign(bias=bias, variance=rows[f"variance_{end}"], rmse_rel=error)


def lead(first: RequiredCost, second: RequiredCost, alike: bool = False) -> tuple[float, float, float]:
    """Return the ratio of the second cost to the first, and the ends of its 95% interval.

    ``alike`` means the same estimator on two backends: only the noise of timing counts.
    """
    factor = second.cost / first.cost
    noise = (first.times, second.times)
    low = math.hypot(*noise) if alike else math.hypot(first.up, second.down, *noise)
    high = math.hypot(*noise) if alike else math.hypot(first.down, second.up, *noise)
    return factor, factor * math.exp(-low), factor * math.exp(high)


def _required_cost(rows: pd.DataFrame, target: float, cost: Cost) -> RequiredCost:
    n, error, price = (rows.index.to_numpy(float), rows["rmse_rel"].to_numpy(float), cost.of(rows).to_numpy(float))
    if not (error <= target).any():
        return _extrapolated_cost(rows.iloc[-1], n[-1], price[-1], target)
    # more samples may cost less: the fixed cost of a call dominates small batches
    ways = [RequiredCost("measured", price[i], n[i]) for i in range(1, len(n)) if error[i] <= target]
    for i in range(1, len(n)):
        if error[i] <= target < error[i - 1]:
            share = math.log(error[i - 1] / target) / math.log(error[i - 1] / error[i])
            samples, needed = (math.exp((1 - share) * math.log(v[i - 1]) + share * math.log(v[i])) for v in (n, price))
            ways.append(RequiredCost("measured", needed, samples))
    if error[0] <= target:
        ways.append(RequiredCost("at once", price[0], n[0]))
    return min(ways, key=lambda way: (way.cost, way.samples))


def _extrapolated_cost(row: Any, samples: float, price: float, target: float) -> RequiredCost:
    """Extrapolate the cost from the row with most samples: v is N times its variance, and cost is proportional to N."""
    low, high, bias = (row[name] / row["reference_norm"] for name in ("bias_low", "bias_high", "bias"))
    if low >= target:
        # an estimator without declared bias may only have heavy tails that the samples missed
        return RequiredCost("unknown" if is_unexplained(str(row.get("reason", ""))) else "never")
    if not high < target:
        return RequiredCost("unknown")
    certain_bias = bias if low > 0 else 0.0
    needed = samples * row["variance"] / row["reference_norm"] ** 2 / (target**2 - certain_bias**2)
    factor = max(needed / samples, 1.0)
    return RequiredCost("extrapolated", price * factor, samples * factor)


def table(shown: Arranged) -> pd.DataFrame:
    """Return a line per problem, kind of cost and target error; empty if samples were not swept."""
    if shown.rows["samples"].nunique() < 2:
        return pd.DataFrame()
    costs = (("time", TIME), ("rollouts", ROLLOUTS))
    timed = bool(np.isfinite(shown.rows["time_s"]).any())
    entries = [
        line(problem, target, kind, cost)
        for problem in split_by_problem(shown, SAMPLES, ("scene",))
        if problem.rows["x"].nunique() > 1
        for kind, cost in costs[0 if timed else 1 :]
        for target in TARGETS
    ]
    return pd.DataFrame(entries)


def methods(problem: ProblemRows, target: float, cost: Cost) -> dict[str, RequiredCost]:
    """Return each method's cost to reach an error. For time a method is an estimator on a backend, else an estimator."""
    reached: dict[str, RequiredCost] = {}
    for curve in estimator_curves(problem.rows, close=None):
        name = curve.label if cost is ROLLOUTS else f"{curve.label} on {curve.rows['backend'].iloc[0]}"
        needed = required_cost(curve, target, cost)
        if name not in reached or needed.cost < reached[name].cost or math.isnan(reached[name].cost):
            reached[name] = needed
    return reached


def estimator_of(method: str) -> str:
    """Return the estimator of a method: ``fobg`` of ``fobg on jax``."""
    return method.partition(" on ")[0]


def line(problem: ProblemRows, target: float, kind: str, cost: Cost) -> dict[str, Any]:
    """Return a line of the table: the cheapest method, the next (if possible of another estimator), and excluded ones."""
    reached = methods(problem, target, cost)
    ranked = sorted((r.cost, name) for name, r in reached.items() if math.isfinite(r.cost))
    entry: dict[str, Any] = {
        "fastest": "-",
        "cost": math.nan,
        "samples": math.nan,
        "how": "-",
        "next": "-",
        "factor": math.nan,
        "factor_low": math.nan,
        "factor_high": math.nan,
    }
    if ranked:
        best = reached[ranked[0][1]]
        entry |= {"fastest": ranked[0][1], "cost": best.cost, "samples": math.ceil(best.samples), "how": best.how}
    elif any(r.how == "unknown" for r in reached.values()):
        entry["how"] = "no bias known to be below"
    else:
        entry["how"] = "never"
    others = [name for _, name in ranked if estimator_of(name) != estimator_of(ranked[0][1])]
    following = others[0] if others else ranked[1][1] if len(ranked) > 1 else ""
    if following:
        factor, low, high = lead(reached[ranked[0][1]], reached[following], alike=not others)
        entry |= {"next": following, "factor": factor, "factor_low": low, "factor_high": high}
    out = {how: ", ".join(name for name, r in reached.items() if r.how == how) or "-" for how in ("never", "unknown")}
    return {"problem": problem.title(), "relative error": target, "by": kind, **entry, **out}


def accuracy_table(best: pd.DataFrame) -> Table:
    """Return the table of :func:`table` for readers."""
    kinds = {"time": TIME, "rollouts": ROLLOUTS}
    costs = [
        kinds[kind].text(float(number(cost))) if math.isfinite(cost) else "-"
        for kind, cost in zip(best["by"], best["cost"], strict=True)
    ]
    columns = [
        text("problem"), Column("relative error", format="percent"), text("by"), text("fastest"), text("cost_text", label="cost"),
        Column("samples", format="setting"), text("how"), text("next"),
        Column("factor", low="factor_low", high="factor_high"), text("never"), text("unknown"),
    ]  # fmt: skip
    return Table(
        "time_to_accuracy", best.assign(cost_text=costs), columns, "the method that reaches an error at the lowest cost", NOTES,
        terminal=True, details=("never", "unknown"), data=best,
    )  # fmt: skip


def comparisons(best: pd.DataFrame) -> pd.DataFrame:
    """Return the lines of the table of comparisons: who reaches an error first, and by what factor."""
    return pd.DataFrame({
        "problem": best["problem"], "axis": "", "at": math.nan,
        "basis": [f"{by} to {target:.0%}" for by, target in zip(best["by"], best["relative error"], strict=True)],
        "first": best["fastest"].where(best["fastest"] != "-", ""), "value": best["cost"],
        "value_low": math.nan, "value_high": math.nan, "second": best["next"].where(best["next"] != "-", ""),
        "factor": best["factor"], "factor_low": best["factor_low"], "factor_high": best["factor_high"],
        "tied": [(e["next"],) if e["next"] != "-" and not e["factor_low"] > 1 else () for e in best.to_dict("records")],
    })  # fmt: skip


def sentence(entry: Any) -> str:
    """Format a line of the table in a few words: ``10%: fobg on jax, 3.8 times ahead [2.7, 5.2]``, or why it is open."""
    what = f"{entry['relative error']:.0%}: "
    if entry["fastest"] == "-":
        return what + (
            "none, all have a larger bias" if entry["how"] == "never" else "open, no bias is known to be below"
        )
    if entry["next"] == "-":
        return f"{what}only {entry['fastest']}"
    if not entry["factor_low"] > 1.0:
        first, second = entry["fastest"], entry["next"]
        if estimator_of(first) != estimator_of(second):
            first, second = estimator_of(first), estimator_of(second)
        return f"{what}open, {first} or {second}"
    low, high = number(entry["factor_low"]), number(entry["factor_high"])
    return f"{what}{estimator_of(entry['fastest'])}, {number(entry['factor'])} times ahead [{low}, {high}]"


def _is_clearly_first(entry: Any) -> bool:
    """Return whether the first estimator's lead is certain: no other reaches the error, or the interval lies above 1."""
    if entry["fastest"] == "-":
        return False
    alone = entry["next"] == "-" or estimator_of(entry["next"]) == estimator_of(entry["fastest"])
    return alone or bool(entry["factor_low"] > 1.0)


def finding(best: pd.DataFrame) -> str:
    """Return which estimator is certainly first to each error most often, and on how many problems that is open."""
    kind = "time" if (best["by"] == "time").any() else "rollouts"
    clauses: list[str] = []
    before = ""
    entries = best[best["by"] == kind].to_dict("records")
    for target in TARGETS:
        asked = [entry for entry in entries if entry["relative error"] == target]
        clear = [e["fastest"] for e in asked if _is_clearly_first(e)]
        if not clear:
            clauses.append(f"nobody is certainly first to {target:.0%}")
            continue
        leader, count = Counter(map(estimator_of, clear)).most_common(1)[0]
        ways = {method for method in clear if estimator_of(method) == leader}
        name = ways.pop() if len(ways) == 1 else leader
        factors = [e["factor"] for e in asked if e["fastest"] in (name, leader) and _is_clearly_first(e)]
        ahead = (
            f", {_range([f for f in factors if math.isfinite(f)])} times ahead"
            if any(map(math.isfinite, factors))
            else ""
        )
        who = "" if name == before else f"{name} is first "
        before = name
        clauses.append(f"{who}to {target:.0%} error on {count} of {counted(len(asked), 'problem')}{ahead}")
    text = ", and ".join(clauses)
    return f"{text[0].upper() if text.startswith('nobody') else text[0]}{text[1:]}."


def _range(values: list[float]) -> str:
    low, high = number(min(values)), number(max(values))
    return low if low == high else f"{low} to {high}"
