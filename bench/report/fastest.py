"""For a given relative error, which estimator on which backend is fastest, and by what factor over the next.

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

from bench.grid import Experiment
from bench.report.costs import ROLLOUTS, TIME, Cost
from bench.report.tables import plain_markdown
from bench.report.views import Family, Line, along, axis_value, families, lines, number
from bench.store import write_whole

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
    """What a method needs for an error, or why it cannot be told."""

    how: str
    """``measured``, ``at once``, ``extrapolated``, ``never`` or ``unknown``."""
    cost: float = math.nan
    samples: float = math.nan


def reach(line: Line, target: float, cost: Cost) -> Reached:
    """What the estimator on its backend needs for a relative RMSE of ``target``."""
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
    """From the row with most samples: v is N times its variance, and the cost is proportional to N."""
    low, high, bias = (row[name] / row["reference_norm"] for name in ("bias_low", "bias_high", "bias"))
    if low >= target:
        return Reached("never")
    if not high < target:
        return Reached("unknown")
    kept = bias if low > 0 else 0.0
    needed = samples * row["variance"] / row["reference_norm"] ** 2 / (target**2 - kept**2)
    factor = max(needed / samples, 1.0)
    return Reached("extrapolated", price * factor, samples * factor)


def table(experiment: Experiment, rows: pd.DataFrame) -> pd.DataFrame:
    """A line per problem, kind of cost and target; empty where samples were not swept."""
    found = [
        _line(problem, target, kind, cost)
        for problem in families(along(rows, "samples", experiment), ("scene",))
        if problem.rows["x"].nunique() > 1
        for kind, cost in (("time", TIME), ("rollouts", ROLLOUTS))
        for target in TARGETS
    ]
    return pd.DataFrame(found)


def _line(problem: Family, target: float, kind: str, cost: Cost) -> dict[str, str]:
    """The fastest method, the next one, and those that are out."""
    reached: dict[str, Reached] = {}
    for line in lines(problem.rows, close=None):
        backend = f" on {line.rows['backend'].iloc[0]}"
        reached[line.label + backend] = reach(line, target, cost)
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
    if len(ranked) > 1:
        texts |= {"next": ranked[1][1], "factor": number(ranked[1][0] / ranked[0][0])}
    out = {how: ", ".join(name for name, r in reached.items() if r.how == how) or "-" for how in ("never", "unknown")}
    return {"problem": problem.title(), "relative error": f"{target:.0%}", "by": kind, **texts, **out}


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``fastest`` (.csv, .md) and print it, where samples were swept."""
    found = table(experiment, rows)
    if found.empty:
        return []
    title = f"# {experiment.name}: which estimator on which backend is fastest for an error"
    contents = {
        "fastest.csv": found.to_csv(index=False, lineterminator="\n"),
        "fastest.md": "\n\n".join([title, plain_markdown(found), *NOTES]) + "\n",
    }
    paths = [experiment.directory / name for name in contents]
    for path, content in zip(paths, contents.values(), strict=True):
        write_whole(path, content.encode())
    _print(found)
    return paths


def _print(found: pd.DataFrame) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = max(console.width, 160)
    shown = Table(title="\nfastest for an error", title_justify="left", box=None, padding=(0, 2, 0, 0))
    kept: Sequence[str] = [name for name in found if name not in ("never", "unknown")]
    for name in kept:
        shown.add_column(name)
    for line in found[kept].to_numpy():
        shown.add_row(*line)
    console.print(shown)
