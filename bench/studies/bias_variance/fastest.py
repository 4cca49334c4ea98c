"""Finds, for a given relative error, which estimator on which backend is fastest, and by what factor.

The mean square error of an estimate from N samples is bias^2 + v / N. Between two measured N it is interpolated; beyond
the largest one it is extrapolated by that law, and only to errors above what is known of the bias.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.report.tables import plain_markdown
from bench.report.text import axis_value, number
from bench.report.views import Family, Line, along, arranged, families, lines
from bench.studies.bias_variance.charts import SAMPLES
from bench.studies.bias_variance.costs import ROLLOUTS, TIME, Cost
from bench.sweep.experiment import Experiment
from bench.sweep.files import write_all

TARGETS = (0.1, 0.01)
"""Relative errors asked for."""
NOTES = (
    "cost: of one estimate, compilation left out; rollouts: a gradient counts as one. how: `measured` between two sample "
    "counts, `at once` where the fewest samples already suffice (the cost is an upper limit), `extrapolated` by RMSE^2 = "
    "bias^2 + v / N beyond the most samples measured, where the 95% limit of the bias lies below the error asked for. "
    "never: methods whose bias exceeds that error. unknown: methods whose bias is not known to be below it.",
)


@dataclass(frozen=True)
class Reached:
    """What a method needs to reach an error, or why that is unknown."""

    how: str
    """``measured``, ``at once``, ``extrapolated``, ``never`` or ``unknown``."""
    cost: float = math.nan
    samples: float = math.nan


def reach(line: Line, target: float, cost: Cost) -> Reached:
    """Return what the estimator on its backend needs for a relative RMSE of ``target``."""
    rows = cost.known(line.rows).sort_index()
    if rows.empty:
        return Reached("unknown")
    n, error, price = (rows.index.to_numpy(float), rows["rmse_rel"].to_numpy(float), cost.of(rows).to_numpy(float))
    enough = np.flatnonzero(error <= target)
    if enough.size == 0:
        return _beyond(rows.iloc[-1], n[-1], price[-1], target)
    first = int(enough[0])
    if first == 0:
        return Reached("at once", price[0], n[0])
    share = math.log(error[first - 1] / target) / math.log(error[first - 1] / error[first])
    samples, needed = (math.exp((1 - share) * math.log(v[first - 1]) + share * math.log(v[first])) for v in (n, price))
    return Reached("measured", needed, samples)


def _beyond(row: Any, samples: float, price: float, target: float) -> Reached:
    """Extrapolate from the row with most samples: v is N times its variance, and the cost is proportional to N."""
    low, high, bias = (row[name] / row["reference_norm"] for name in ("bias_low", "bias_high", "bias"))
    if low >= target:
        return Reached("never")
    if not high < target:
        return Reached("unknown")
    certain_bias = bias if low > 0 else 0.0
    needed = samples * row["variance"] / row["reference_norm"] ** 2 / (target**2 - certain_bias**2)
    factor = max(needed / samples, 1.0)
    return Reached("extrapolated", price * factor, samples * factor)


def table(experiment: Experiment, rows: pd.DataFrame) -> pd.DataFrame:
    """Return a line per problem, kind of cost and target; empty where samples were not swept."""
    shown = arranged(experiment, rows)
    entries = [
        _line(problem, target, kind, cost)
        for problem in families(shown, along(shown, SAMPLES), ("scene",))
        if problem.rows["x"].nunique() > 1
        for kind, cost in (("time", TIME), ("rollouts", ROLLOUTS))
        for target in TARGETS
    ]
    return pd.DataFrame(entries)


def _line(problem: Family, target: float, kind: str, cost: Cost) -> dict[str, str]:
    """Return the fastest method, the next one, and those that are out."""
    reached: dict[str, Reached] = {}
    for line in lines(problem.rows, close=None):
        name = line.label if cost is ROLLOUTS else f"{line.label} on {line.rows['backend'].iloc[0]}"
        found = reach(line, target, cost)
        if name not in reached or found.cost < reached[name].cost or math.isnan(reached[name].cost):
            reached[name] = found
    ranked = sorted((r.cost, name) for name, r in reached.items() if math.isfinite(r.cost))
    texts = dict.fromkeys(("fastest", "cost", "samples", "how", "next", "factor"), "-")
    if ranked:
        best = reached[ranked[0][1]]
        texts |= {
            "fastest": ranked[0][1],
            "cost": cost.text(float(number(best.cost))),
            "samples": axis_value(math.ceil(best.samples)),
            "how": best.how,
        }
    else:
        texts["how"] = "no bias known to be below" if any(r.how == "unknown" for r in reached.values()) else "never"
    if len(ranked) > 1:
        texts |= {"next": ranked[1][1], "factor": number(ranked[1][0] / ranked[0][0])}
    out = {how: ", ".join(name for name, r in reached.items() if r.how == how) or "-" for how in ("never", "unknown")}
    return {"problem": problem.title(), "relative error": f"{target:.0%}", "by": kind, **texts, **out}


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``fastest`` (.csv, .md), where samples were swept."""
    best = table(experiment, rows)
    if best.empty:
        return []
    title = f"# {experiment.name}: which estimator on which backend is fastest for an error"
    return write_all(
        experiment.directory,
        {
            "fastest.csv": best.to_csv(index=False, lineterminator="\n"),
            "fastest.md": "\n\n".join([title, plain_markdown(best), *NOTES]) + "\n",
        },
    )


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the table, if samples were swept."""
    best = table(experiment, rows)
    if not best.empty:
        _print(best)


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
