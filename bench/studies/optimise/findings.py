"""Formats the findings of the searches as sentences with intervals, and the titles of the charts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from bench.report.study_tables import interval
from bench.report.text import counted, number
from bench.studies.optimise import aggregate
from bench.studies.optimise.aggregate import RunSet

CHANCE = 0.05
"""An order counts as random if a random order is at least as good with more than this probability."""
FEW_SEEDS = 5
"""Fewest searches per problem for a bootstrap interval. With two, half of the resamples are one search twice."""


def sentences(runs: RunSet, default: float) -> list[str]:
    """Return the findings, the answer to the study's question first."""
    if not len(runs.rows):
        return ["No search gave a result: the table has the reason of each."]
    summary = aggregate.summarise(runs, default)
    findings = [
        effect_of_error(aggregate.rank_correlations(aggregate.quality_and_runtime(runs, default))),
        ranking(summary),
        tuning(summary),
        divergence(runs),
    ]
    return [sentence for sentence in findings if sentence]


def effect_of_error(rho: pd.DataFrame) -> str:
    """Format for each class of scenes whether the gradient with the smaller error reaches the target sooner."""
    if rho.empty:
        return "Whether a better gradient pays is not known: no gradient's quality was measured."
    parts = []
    for row in rho[rho["scene_class"] != "all"].to_dict("records"):
        if math.isnan(row["rho"]) or row["points"] < 4:
            parts.append(f"{row['scene_class']}: not known from {counted(row['points'], 'point')}")
            continue
        figures = f"rho {row['rho']:.2f} [{row['rho_low']:.2f}, {row['rho_high']:.2f}], {row['points']} points"
        if row["chance"] > CHANCE:
            parts.append(
                f"{row['scene_class']}: not known ({figures}; a random order is as good {row['chance']:.0%} of the time)"
            )
        elif row["rho_low"] > 0:
            parts.append(f"{row['scene_class']}: yes ({figures})")
        elif row["rho_high"] < 0:
            parts.append(f"{row['scene_class']}: no, later ({figures})")
        else:
            parts.append(f"{row['scene_class']}: not known ({figures})")
    return "Does the gradient with the smaller error at the start reach the target sooner? " + "; ".join(parts) + "."


def effect_title(rho: pd.DataFrame) -> str:
    """Return the title of quality against runtime: the classes where the better gradient is sooner or later."""
    classes = rho[rho["scene_class"] != "all"].to_dict("records")
    known = [row for row in classes if row["points"] >= 4 and row["chance"] <= CHANCE]
    sure = {
        "sooner": [row["scene_class"] for row in known if row["rho_low"] > 0],
        "later": [row["scene_class"] for row in known if row["rho_high"] < 0],
    }
    parts = [
        f"the better gradient reaches the target {when} on {' and '.join(on)} scenes" for when, on in sure.items() if on
    ]
    unsure = [row["scene_class"] for row in classes if row["scene_class"] not in (*sure["sooner"], *sure["later"])]
    parts += [f"not known on {', '.join(unsure)} scenes"] if unsure else []
    text = "; ".join(parts)
    if not any(sure.values()):
        return f"Whether the better gradient reaches the target sooner is {text}"
    return text[:1].upper() + text[1:]


def score_title(summary: pd.DataFrame) -> str:
    """Return the title of the paths: the method with the best score, and the best method that uses gradients."""
    known = summary[summary["score"].notna()].sort_values("score", ascending=False)
    return _best("Best score", [(row["method"], number(row["score"], 3)) for row in known.to_dict("records")])


def targets_title(shares: Mapping[str, float]) -> str:
    """Return the title of targets reached: the method with the largest share, and the best method that uses gradients."""
    order = sorted(shares.items(), key=lambda item: -item[1])
    return _best("Most targets reached", [(name, f"{share:.0%}") for name, share in order])


def _best(heading: str, order: Sequence[tuple[str, str]]) -> str:
    """Format the methods tied for first and, if none of them uses gradients, the first method that does."""
    if not order:
        return "No method has a score"
    figure = order[0][1]
    level = [name for name, value in order if value == figure]
    text = f"{heading}: {' and '.join(level)} ({figure})"
    if not any(", " in name for name in level):  # names without a comma have no estimator
        following = next(((name, value) for name, value in order if ", " in name), None)
        text += f"; with gradients {following[0]} ({following[1]})" if following else ""
    return text


def tuning_title(lines: pd.DataFrame) -> str:
    """Return the title of scores by tuning: the method and problem whose score changes most."""
    spread = lines.groupby(["method", "problem"], sort=False)["score"].agg(["min", "max"])
    far = (spread["max"] - spread["min"]).sort_values(ascending=False)
    method, problem = far.index[0]
    low, high = spread.loc[far.index[0]]
    scene = str(problem).partition(",")[0]
    return f"Tuning alone changes the score of {method} from {number(low, 2)} to {number(high, 2)} on {scene}"


def ranking(summary: pd.DataFrame) -> str:
    """Format which method has the best score, and which methods are not distinguishable from it; empty without scores."""
    known = summary[summary["score"].notna()].sort_values("score", ascending=False)
    if known.empty:
        return ""
    first = known.iloc[0]
    text = f"Best score: {first['method']} with {interval(first, 'score', digits=3)}"
    if known["searches"].sum() < FEW_SEEDS * known["problems"].sum():
        text += f" (fewer than {FEW_SEEDS} seeds: the intervals are too narrow)"
    level = known.iloc[1:][known.iloc[1:]["score_high"] >= first["score_low"]]["method"]
    return text + (
        f"; not distinguishable from it: {', '.join(level)}." if len(level) else "; no other interval overlaps it."
    )


def tuning(summary: pd.DataFrame) -> str:
    """Format the largest change of a score by tuning only, and the range of the methods' best scores."""
    tuned = summary[(summary["tunings"] > 1) & summary["score"].notna()]
    if tuned.empty:
        return "Nothing was tuned: a comparison at one learning rate compares rates as much as gradients."
    change = tuned["score"] - tuned["median_score"]
    worst = tuned.loc[change.idxmax()]
    spread = summary["score"].max() - summary["score"].min()
    return (
        f"Tuning alone changes the score of {worst['method']} by {number(change.max())} (best of {worst['tunings']} "
        f"tunings minus their median); the methods' best scores span {number(spread)}."
    )


def divergence(runs: RunSet) -> str:
    """Format how many searches diverged, by method."""
    diverged = runs.rows[runs.rows["stopped"] == "diverged"]
    if diverged.empty:
        return "No search diverged."
    by = ", ".join(f"{name} {count}" for name, count in diverged["method"].value_counts().items())
    return f"{len(diverged)} of {counted(len(runs.rows), 'search', 'searches')} diverged: {by}."
