"""What searches show, in sentences with their intervals; what they cannot tell is said as such."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from bench.report.text import counted, number
from bench.studies.optimise import aggregate
from bench.studies.optimise.aggregate import RunSet

CHANCE = 0.05
"""Chance above which an order may be random."""

FEW_SEEDS = 5
"""Bootstrap intervals of fewer searches are too narrow: with two, half of the resamples are one search twice."""


def sentences(found: RunSet, default: float) -> list[str]:
    """Return the findings, the answer to the question first."""
    if not len(found.rows):
        return ["No search gave a result: the table has the reason of each."]
    summed = aggregate.summary(found, default)
    said = [
        pays(aggregate.correlations(aggregate.quality(found, default))),
        ranking(summed),
        tuning(summed),
        stops(found),
    ]
    return [sentence for sentence in said if sentence]


def pays(rho: pd.DataFrame) -> str:
    """Say for each class of scene whether the smaller error arrives sooner: yes, no, or not known."""
    if rho.empty:
        return "Whether a better gradient pays is not known: no search has a gradient whose quality was measured."
    parts = []
    for row in rho[rho["scene_class"] != "all"].to_dict("records"):
        if math.isnan(row["rho"]) or row["points"] < 4:
            parts.append(f"{row['scene_class']}: not known from {counted(row['points'], 'point')}")
            continue
        figures = f"rho {row['rho']:.2f} [{row['rho_low']:.2f}, {row['rho_high']:.2f}], {row['points']} points"
        if row["chance"] > CHANCE:
            parts.append(
                f"{row['scene_class']}: not known ({figures}; random order does as well {row['chance']:.0%} of the time)"
            )
        elif row["rho_low"] > 0:
            parts.append(f"{row['scene_class']}: yes ({figures})")
        elif row["rho_high"] < 0:
            parts.append(f"{row['scene_class']}: no, the reverse ({figures})")
        else:
            parts.append(f"{row['scene_class']}: not known ({figures})")
    return "Does the gradient with the smaller error at the start arrive sooner? " + "; ".join(parts) + "."


def sooner(rho: pd.DataFrame) -> str:
    """Write in a title on which classes of scenes the smaller error arrives sooner."""
    classes = rho[rho["scene_class"] != "all"].to_dict("records")
    known = [row for row in classes if row["points"] >= 4 and row["chance"] <= CHANCE]
    sure = {
        "sooner": [row["scene_class"] for row in known if row["rho_low"] > 0],
        "later": [row["scene_class"] for row in known if row["rho_high"] < 0],
    }
    said = [f"the better gradient arrives {when} on {' and '.join(on)} scenes" for when, on in sure.items() if on]
    unsure = [row["scene_class"] for row in classes if row["scene_class"] not in (*sure["sooner"], *sure["later"])]
    said += [f"not known on {', '.join(unsure)} scenes"] if unsure else []
    text = "; ".join(said)
    return (
        text[:1].upper() + text[1:] if any(sure.values()) else f"Whether the better gradient arrives sooner is {text}"
    )


def closest(summed: pd.DataFrame) -> str:
    """Write in a title which method comes closest to J*, and which first of those with gradients."""
    known = summed[summed["score"].notna()].sort_values("score", ascending=False)
    return _first([(row["method"], number(row["score"], 3)) for row in known.to_dict("records")], "the best score")


def reaches(shares: Mapping[str, float]) -> str:
    """Write in a title which method reaches most targets, and which first of those with gradients."""
    order = sorted(shares.items(), key=lambda item: -item[1])
    return _first([(name, f"{share:.0%}") for name, share in order], "most targets reached")


def _first(order: Sequence[tuple[str, str]], what: str) -> str:
    if not order:
        return "No method got anywhere"
    figure = order[0][1]
    level = [name for name, value in order if value == figure]
    said = f"{what[:1].upper()}{what[1:]}: {' and '.join(level)} ({figure})"
    if not any(", " in name for name in level):  # they look at costs only
        following = next(((name, value) for name, value in order if ", " in name), None)
        said += f"; with gradients {following[0]} ({following[1]})" if following else ""
    return said


def moved(lines: pd.DataFrame) -> str:
    """Write in a title where the tuning alone moves a method most."""
    spread = lines.groupby(["method", "problem"], sort=False)["score"].agg(["min", "max"])
    far = (spread["max"] - spread["min"]).sort_values(ascending=False)
    method, problem = far.index[0]
    low, high = spread.loc[far.index[0]]
    return f"Tuning alone moves {method} from {number(low, 2)} to {number(high, 2)} on {str(problem).partition(',')[0]}"


def ranking(summed: pd.DataFrame) -> str:
    """Say which method has the best score, and which cannot be distinguished from it."""
    known = summed[summed["score"].notna()].sort_values("score", ascending=False)
    if known.empty:
        return ""
    first = known.iloc[0]
    text = f"Best score: {first['method']} with {number(first['score'], 3)} [{number(first['score_low'], 3)}, {number(first['score_high'], 3)}]"
    if known["searches"].sum() < FEW_SEEDS * known["problems"].sum():
        text += f" (fewer than {FEW_SEEDS} seeds: the intervals are too narrow)"
    level = known.iloc[1:][known.iloc[1:]["score_high"] >= first["score_low"]]["method"]
    return text + (
        f"; not distinguishable from it: {', '.join(level)}." if len(level) else "; no other interval reaches it."
    )


def tuning(summed: pd.DataFrame) -> str:
    """Say how far the tuning alone moves a method, beside how far the methods are apart."""
    tuned = summed[(summed["tunings"] > 1) & summed["score"].notna()]
    if tuned.empty:
        return "Nothing was tuned: a comparison at one rate is one of rates as much as of gradients."
    lost = (tuned["score"] - tuned["median_score"]).max()
    worst = tuned.loc[(tuned["score"] - tuned["median_score"]).idxmax()]
    apart = summed["score"].max() - summed["score"].min()
    return (
        f"Tuning alone moves the score of {worst['method']} by {number(lost)} (best of {worst['tunings']} against their "
        f"median), the methods at their best are {number(apart)} apart."
    )


def stops(found: RunSet) -> str:
    """Say how many searches diverged."""
    lost = found.rows[found.rows["stopped"] == "diverged"]
    if lost.empty:
        return "No search diverged."
    by = ", ".join(f"{name} {count}" for name, count in lost["method"].value_counts().items())
    return f"Of {counted(len(found.rows), 'search', 'searches')} {len(lost)} diverged: {by}."
