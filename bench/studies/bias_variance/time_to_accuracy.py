"""Finds the method (estimator and backend) that reaches a relative error at the lowest cost, and its lead over the next.

The mean square error of an estimate from N samples is bias^2 + v / N. Between two measured N the error is interpolated.
Beyond the largest N it is extrapolated by that law, only to errors above the 95% limit of the bias.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis
from bench.experiment.experiment import Experiment
from bench.measure.statistics import is_unexplained
from bench.report.problems import ProblemRows, split_by_problem
from bench.report.tables import escape_markdown, plain_markdown
from bench.report.text import axis_value, counted, number
from bench.report.views import Curve, arrange, estimator_curves
from bench.run.files import write_all
from bench.studies.bias_variance.costs import ROLLOUTS, TIME, Cost, with_gradient_cost

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


def table(experiment: Experiment, rows: pd.DataFrame) -> pd.DataFrame:
    """Return a line per problem, kind of cost and target error; empty if samples were not swept."""
    if rows["samples"].nunique() < 2:
        return pd.DataFrame()
    shown = arrange(experiment, with_gradient_cost(rows))
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


def texts(best: pd.DataFrame) -> pd.DataFrame:
    """Return the table with its numbers formatted as strings."""
    shown = best.astype(object)
    kinds = {"time": TIME, "rollouts": ROLLOUTS}
    shown["relative error"] = [f"{value:.0%}" for value in best["relative error"]]
    shown["cost"] = [
        kinds[kind].text(float(number(cost))) if math.isfinite(cost) else "-"
        for kind, cost in zip(best["by"], best["cost"], strict=True)
    ]
    shown["samples"] = [axis_value(value) for value in best["samples"]]
    ends = zip(best["factor"], best["factor_low"], best["factor_high"], strict=True)
    shown["factor"] = [
        number(value) + (f" ({number(low)} to {number(high)})" if math.isfinite(low) else "")
        for value, low, high in ends
    ]
    return shown.drop(columns=["factor_low", "factor_high"])


def sentence(entry: Any) -> str:
    """Format a line of the table as a sentence: the cheapest method, and how many times the next one costs."""
    what = f"to {entry['relative error']:.0%}"
    if entry["fastest"] == "-":
        never = "nobody, all have a larger bias"
        return f"{what}: {never if entry['how'] == 'never' else 'not known, no bias is certain to be below'}"
    if entry["next"] == "-":
        return f"{what}: only {entry['fastest']}"
    if not entry["factor_low"] > 1.0:
        return f"{what}: {entry['fastest']} or {entry['next']}, not distinguishable"
    low, high = number(entry["factor_low"]), number(entry["factor_high"])
    return f"{what}: {entry['fastest']}, {number(entry['factor'])} times ({low} to {high}) before {entry['next']}"


def sentences(best: pd.DataFrame) -> list[str]:
    """Return a sentence per problem: the method that reaches each error first in time (in rollouts if untimed)."""
    kind = "time" if (best["by"] == "time").any() else "rollouts"
    chosen = best[best["by"] == kind].to_dict("records")
    by_problem: dict[str, list[str]] = {}
    for entry in chosen:
        by_problem.setdefault(entry["problem"], []).append(sentence(entry))
    return [f"{problem}: {'; '.join(sentences)}." for problem, sentences in by_problem.items()]


def _is_clearly_first(entry: Any) -> bool:
    """Return whether the first estimator's lead is certain: no other reaches the error, or the interval lies above 1."""
    if entry["fastest"] == "-":
        return False
    alone = entry["next"] == "-" or estimator_of(entry["next"]) == estimator_of(entry["fastest"])
    return alone or bool(entry["factor_low"] > 1.0)


def summarise_leaders(entries: Sequence[Any]) -> str:
    """Format which estimator is certainly first most often: ``fobg is first to 10% error on 5 of 6 problems, to 1% on 4``."""
    clauses: list[str] = []
    before = ""
    for target in dict.fromkeys(entry["relative error"] for entry in entries):
        asked = [entry for entry in entries if entry["relative error"] == target]
        clear = [e["fastest"] for e in asked if _is_clearly_first(e)]
        leader, count = Counter(map(estimator_of, clear)).most_common(1)[0] if clear else ("nobody", len(asked))
        ways = {method for method in clear if estimator_of(method) == leader}
        name = ways.pop() if len(ways) == 1 else leader
        who = "" if name == before else f"{name} is {'certainly ' * (not clear)}first "
        error, among = " error" * (not clauses), f" of {counted(len(asked), 'problem')}" if name != before else ""
        clauses.append(f"{who}to {target:.0%}{error} on {count}{among}")
        before = name
    return ", ".join(clauses)


def summarise_accuracy_and_cost(problems: Sequence[ProblemRows], cost: Cost) -> str:
    """Format which estimators are most accurate and cheapest on most problems, and where the cheapest is useless."""
    accurate: Counter[str] = Counter()
    cheap: Counter[str] = Counter()
    useless: Counter[str] = Counter()
    for problem in problems:
        known = [(line.label, cost.known(line.rows)) for line in estimator_curves(problem.rows, close=None)]
        rows = pd.concat([rows.assign(label=label, at=cost.of(rows)) for label, rows in known])
        best, first = (rows.sort_values(by, kind="stable").iloc[0] for by in ("rmse_rel", "at"))
        accurate[best["label"]] += 1
        cheap[first["label"]] += 1
        useless[first["label"]] += bool(first["rmse_rel"] >= 1.0)
    (best_, wins), (first_, times) = accurate.most_common(1)[0], cheap.most_common(1)[0]
    costs = "needs fewest rollouts" if cost is ROLLOUTS else "is fastest"
    second = f" and {costs.removeprefix('is ')} on {times}" if best_ == first_ else f"; {first_} {costs} on {times}"
    text = f"{best_} is most accurate on {wins} of {counted(len(problems), 'problem')}{second}"
    return text + (f", no better than zero on {useless[first_]} of these" if useless[first_] else "")


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``time_to_accuracy`` (.csv, .md) if samples were swept; return the files' paths."""
    best = table(experiment, rows)
    if best.empty:
        return []
    title = f"# {experiment.name}: which estimator on which backend is fastest for an error"
    return write_all(
        experiment.directory,
        {
            "time_to_accuracy.csv": best.to_csv(index=False, lineterminator="\n"),
            "time_to_accuracy.md": "\n\n".join(
                [title, *map(escape_markdown, sentences(best)), plain_markdown(texts(best)), *NOTES]
            )
            + "\n",
        },
    )


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the table if samples were swept."""
    best = table(experiment, rows)
    if not best.empty:
        _print(texts(best))


def _print(best: pd.DataFrame) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = max(console.width, 160)
    shown = Table(title="\nfastest for an error", title_justify="left", box=None, padding=(0, 2, 0, 0))
    kept: Sequence[str] = [name for name in best if name not in ("never", "unknown")]
    for name in kept:
        shown.add_column(name)
    for line in best[kept].to_numpy():
        shown.add_row(*line)
    console.print(shown)
