"""States what searches show in at most three sentences: what reaches most targets, what tuning costs, what errors cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

from bench.measure.performance import Z
from bench.report.text import counted, number
from bench.studies.optimise import aggregate
from bench.studies.optimise.aggregate import RunSet

CHANCE = 0.05
"""An order counts as random if a random order is at least as good with more than this probability."""
NAMED = 3
"""Most tied methods that a sentence names."""
Name = Callable[[str], str]


def sentences(runs: RunSet, default: float, name: Name = str) -> list[str]:
    """Return the findings; ``name`` shortens the name of a method."""
    summary = aggregate.summarise(runs, default)
    texts = [
        recommendation(summary, name),
        failures(runs, summary, name),
        effect_of_error(aggregate.effects_of_error(runs, default)),
    ]
    return [sentence for sentence in texts if sentence]


def has_estimator(method: str) -> bool:
    """Return whether a method has an estimator: its name is then ``estimator, optimizer``."""
    return ", " in method


def tied_with_best(summary: pd.DataFrame) -> pd.DataFrame:
    """Return the methods that reach most targets, the first one first, and those not distinguishable from it.

    Methods that were not run on all problems are not compared.
    """
    full = summary[summary["problems"] == summary["problems"].max()].sort_values(
        "reached", ascending=False, kind="stable"
    )
    best = full.iloc[0]
    error = np.sqrt(best["reached_se"] ** 2 + full["reached_se"] ** 2)
    return full[(best["reached"] - full["reached"] < Z * error) | (full["method"] == best["method"])]


def recommendation(summary: pd.DataFrame, name: Name = str) -> str:
    """Return which method reaches most targets, its ties, and the best method with an estimator."""
    tied = tied_with_best(summary)
    best = tied.iloc[0]
    if not best["reached"] > 0:
        return "No method reaches any target."
    if len(summary) == 1:
        return f"{name(best['method'])} reaches {_share(best)} of the targets."
    if len(tied) == len(summary):
        return f"Which method to use is open: {name(best['method'])} reaches most targets ({_share(best)}), and no other is distinguishable from it."
    others = [name(method) for method in tied["method"][1:]]
    also = f", not distinguishable from {_join(others) if len(others) <= NAMED else counted(len(others), 'other')}"
    text = f"Use {name(best['method'])}: it reaches most targets ({_share(best)}{also if others else ''})"
    graded = summary[[has_estimator(method) for method in summary["method"]]]
    if has_estimator(best["method"]) or graded.empty:
        return f"{text}."
    tied = tied_with_best(graded)
    first = tied.iloc[0]
    others = [name(method) for method in tied["method"][1:]]
    also = f" or {_join(others)}" if 0 < len(others) <= NAMED else ""
    return f"{text}, or with an estimator {name(first['method'])} ({_share(first)}){also}."


def failures(runs: RunSet, summary: pd.DataFrame, name: Name = str) -> str:
    """Return what tuning alone changes, and how many searches diverged."""
    tuned = summary[(summary["tunings"] > 1) & summary["score"].notna() & summary["median_score"].notna()]
    parts = []
    if tuned.empty:
        parts.append("nothing was tuned, so that a difference between methods may be one of their rates")
    else:
        worst = tuned.loc[(tuned["score"] - tuned["median_score"]).idxmax()]
        parts.append(
            f"tuning alone changes the score of {name(worst['method'])} from {number(worst['median_score'])}, its median over "
            f"{worst['tunings']} tunings, to {number(worst['score'])} at the best"
        )
    diverged = runs.rows[runs.rows["stopped"] == "diverged"]
    if len(diverged):
        by = _join([f"{name(str(method))} {count}" for method, count in diverged["method"].value_counts().items()])
        parts.append(f"{len(diverged)} of {counted(len(runs.rows), 'search', 'searches')} diverged ({by})")
    text = ", and ".join(parts)
    return f"{text[:1].upper()}{text[1:]}."


def effect_of_error(rho: pd.DataFrame, figures: bool = True) -> str:
    """Return on which classes of scenes gradients with smaller errors reach the target sooner, later, or it is open.

    With ``figures`` the sentence has the rank correlations.
    """
    rows = rho.to_dict("records")
    if not rows:
        return "Whether a better gradient pays is open: no gradient's quality was measured."
    verdicts = {row["scene_class"]: verdict(row) for row in rows}
    parts = []
    for kind in ("sooner", "later"):
        on = [row for row in rows if verdicts[row["scene_class"]] == kind]
        if on:
            names = _join(
                [f"{row['scene_class']} scenes" + (f" ({correlation(row)})" if figures else "") for row in on]
            )
            parts.append(f"gradients with a smaller error reach a tenth of the first regret {kind} on {names}")
    unsure = [row["scene_class"] for row in rows if verdicts[row["scene_class"]] == "open"]
    if unsure and parts:
        parts.append(f"this is open on {_join(unsure)} scenes")
    elif unsure:
        return f"Whether gradients with a smaller error reach the target sooner is open on {_join(unsure)} scenes."
    text = ", and ".join(parts)
    return f"{text[:1].upper()}{text[1:]}."


def verdict(row: dict[str, float]) -> str:
    """Return ``sooner`` or ``later`` where the whole interval of the rank correlation is on one side of 0, else ``open``."""
    if not row["points"] >= aggregate.FEWEST_POINTS or not row["chance"] <= CHANCE:
        return "open"
    return "sooner" if row["rho_low"] > 0 else "later" if row["rho_high"] < 0 else "open"


def correlation(row: dict[str, float]) -> str:
    """Return a rank correlation with its interval and the number of points."""
    low, high = number(row["rho_low"]), number(row["rho_high"])
    return f"rank correlation {number(row['rho'])} [{low}, {high}], {row['points']:.0f} points"


def tuning_title(lines: pd.DataFrame, name: Name = str) -> str:
    """Return the title of scores by tuning: the method and problem whose score changes most."""
    spread = lines.groupby(["method", "problem"], sort=False)["score"].agg(["min", "max"])
    method, problem = (spread["max"] - spread["min"]).idxmax()
    low, high = spread.loc[(method, problem)]
    scene = str(problem).partition(",")[0]
    return f"Tuning alone changes the score of {name(method)} from {number(low)} to {number(high)} on {scene}"


def _share(row: pd.Series) -> str:
    low, high = (f"{row[f'reached_{end}']:.0%}" for end in ("low", "high"))
    return f"{row['reached']:.0%} [{low}, {high}]"


def _join(parts: Sequence[str]) -> str:
    return " and ".join([", ".join(parts[:-1]), parts[-1]]) if len(parts) > 1 else "".join(parts)
