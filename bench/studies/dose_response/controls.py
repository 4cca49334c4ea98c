"""Methods that use only costs beside gradients: what each takes to 1/100 of the first regret, problem by problem."""

from __future__ import annotations

import numpy as np
import pandas as pd

from bench.experiment.columns import Column, text
from bench.experiment.views import Chart, Style, Table
from bench.report.style import MARKERS, PALETTE
from bench.report.text import counted, listed, number, span
from bench.studies.dose_response.analysis import BEST, MAIN, PLANTED

COSTS_ONLY = "costs only"
FIRST_TARGET = 10.0
"""The easiest target: a method that misses it in every search has found nothing."""
EVALUATIONS = Column("evaluations", label="rollouts and gradients to 1/100", low="fewest", high="most", log=True)
NOTES = (
    "Medians over the searches of a method: updates times the rollouts and gradients of an update, a gradient counted as one "
    "rollout. Costs and the best gradient have no noise, `fobg` has that of its samples. -: most searches miss the target.",
)


def lines(table: pd.DataFrame) -> pd.DataFrame:
    """Return a line per problem and method without a planted error; empty without methods that use only costs.

    Columns: problem, scene_class, method, kind, runs, hits (searches at 1/100), begun (searches at 1/10), reached,
    evaluations with fewest and most (over the searches), and missed.
    """
    if table.empty or not (table["kind"] == COSTS_ONLY).any():
        return pd.DataFrame(columns=["method"])
    own = table[~table["kind"].isin(PLANTED)]
    begun = (
        own[own["target"] == FIRST_TARGET].set_index("row")["times"].map(lambda times: int(np.isfinite(times).sum()))
    )
    main = own[own["target"] == MAIN]
    unit = (main["rollouts_per_update"] + main["gradients_per_update"]).to_numpy(float)
    times = [np.asarray(values, dtype=float) for values in main["times"]]
    hits = np.array([int(np.isfinite(values).sum()) for values in times])
    missed = ~np.isfinite(main["median"].to_numpy(float))
    spent = {
        "evaluations": [np.median(v) * u for v, u in zip(times, unit, strict=True)],
        "fewest": [v.min() * u for v, u in zip(times, unit, strict=True)],
        "most": [v[np.isfinite(v)].max(initial=0.0) * u for v, u in zip(times, unit, strict=True)],
    }
    frame = main[["problem", "scene_class", "kind"]].assign(
        method=_short(main["method"]), runs=[len(v) for v in times], hits=hits, begun=begun.loc[main["row"]].to_numpy(),
        missed=missed, **{name: np.where(missed, np.nan, values) for name, values in spent.items()},
    )  # fmt: skip
    frame["reached"] = [f"{h} of {n}" for h, n in zip(frame["hits"], frame["runs"], strict=True)]
    return frame.reset_index(drop=True)


def _short(methods: pd.Series) -> list[str]:
    """Return methods without their settings, where the names stay distinct."""
    plain = {method: method.partition("[")[0] for method in methods.unique()}
    repeated = {name for name in plain.values() if list(plain.values()).count(name) > 1}
    return [method if plain[method] in repeated else plain[method] for method in methods]


def findings(known: pd.DataFrame) -> list[str]:
    """Return which methods find nothing where others arrive, and what methods that use only costs take."""
    nothing, parts = [], []
    for problem, own in known.groupby("problem", sort=False):
        lost, safe = own[own["begun"] == 0]["method"], own[own["hits"] == own["runs"]]["method"]
        if len(lost) and len(safe):
            nothing.append(
                f"On {problem}, no search of {listed(lost)} reaches 1/{FIRST_TARGET:g} of the first regret, and all of "
                f"{listed(safe)} reach 1/{MAIN:g}."
            )
    for method, factors, missed in factors_by_method(known):
        n = len(factors) + len(missed)
        range_ = (
            f"{span(min(factors), max(factors))} times on {len(factors)} of {counted(n, 'problem')}" if factors else ""
        )
        misses = f"most searches miss it on {len(missed)} of {n}" if missed else ""
        parts.append(f"{method} {range_} ({misses})" if factors and missed else f"{method} {range_}{misses}")
    compared = f"To 1/{MAIN:g}, over the evaluations of the best gradient: {', '.join(parts)}."
    return [compared, *([" ".join(nothing)] if nothing else [])]


def factors_by_method(known: pd.DataFrame) -> list[tuple[str, list[float], list[str]]]:
    """Return for each method that uses only costs its evaluations over the best gradient's, and the problems that it misses."""
    best = known[(known["kind"] == BEST) & ~known["missed"]].set_index("problem")["evaluations"]
    result = []
    for method, own in known[known["kind"] == COSTS_ONLY].groupby("method", sort=False):
        own = own[own["problem"].isin(best.index)]
        good = own[~own["missed"]]
        factors = (good["evaluations"] / best.loc[good["problem"]].to_numpy()).tolist()
        result.append((str(method), factors, own.loc[own["missed"], "problem"].tolist()))
    return result


def tables(known: pd.DataFrame) -> list[Table]:
    """Return what each method takes on each problem: a row per problem, and a file with a line per problem and method."""
    wide = known.pivot_table(
        index=["problem", "scene_class"], columns="method", values="evaluations", sort=False, dropna=False
    )
    pairs = zip(known["problem"], known["scene_class"], strict=True)  # pivot_table makes all pairs of both
    wide = wide[wide.index.isin(list(pairs))].reset_index()
    columns = [
        text("problem"),
        text("scene_class", label="class"),
        *(Column(name, label=name) for name in wide.columns[2:]),
    ]
    title = "Rollouts and gradients to 1/100 of the first regret"
    shown = known.drop(columns=["missed", "begun"])
    return [Table("reached", wide, columns, title, NOTES, terminal=True, page=True, data=shown)]


def title(known: pd.DataFrame) -> str:
    """Return by how many times every search that uses only costs takes more than any with the best gradient, if it does."""
    most = known[known["kind"] == BEST].set_index("problem")["most"]
    others = known[(known["kind"] == COSTS_ONLY) & ~known["missed"]]
    factors = others["fewest"] / others["problem"].map(most)
    if factors.notna().any() and factors.min() > 1:
        return f"Methods that use only costs take at least {number(factors.min())} times the evaluations of the best gradient"
    return "Methods that use only costs do not always take more evaluations than the best gradient"


def chart(known: pd.DataFrame) -> Chart:
    """Return what each method takes on each problem, a row per problem."""
    methods = list(
        dict.fromkeys(known.sort_values("kind", key=lambda kinds: kinds == COSTS_ONLY, kind="stable")["method"])
    )
    looks = {
        method: Style(PALETTE[i % len(PALETTE)], MARKERS[i % len(MARKERS)], "none") for i, method in enumerate(methods)
    }
    return Chart(
        "reached", title(known), known, [EVALUATIONS],
        [text("problem", label="")], "dots", series="method", styles=looks, failed="missed", height=0.55,
        subtitle=f"To 1/{MAIN:g} of the first regret, each method at its best rate. Cross: most searches miss it",
        text="A dot is the median over the searches of a method and a bar their range. A gradient counts as one rollout.",
    )  # fmt: skip
