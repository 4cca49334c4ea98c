"""Methods that use only costs beside gradients: what each takes to 1/100 of the first regret, problem by problem."""

from __future__ import annotations

import numpy as np
import pandas as pd

from bench.experiment.columns import Column, text
from bench.experiment.views import Chart, Style, Table
from bench.report.style import MARKERS, PALETTE
from bench.studies.dose_response.analysis import MAIN, PLANTED

COSTS_ONLY = "costs only"
EVALUATIONS = Column("evaluations", label="rollouts and gradients to 1/100", low="fewest", high="most", log=True)
NOTES = (
    "Medians over the searches of a method: updates times the rollouts and gradients of an update, a gradient counted as one "
    "rollout. Costs and the best gradient have no noise, `fobg` has that of its samples. -: most searches miss the target.",
)


def lines(table: pd.DataFrame) -> pd.DataFrame:
    """Return a line per problem and method without a planted error; empty without methods that use only costs.

    Columns: problem, scene_class, method, kind, runs, hits (searches at 1/100), reached,
    evaluations with fewest and most (over the searches), and missed.
    """
    if table.empty or not (table["kind"] == COSTS_ONLY).any():
        return pd.DataFrame(columns=["method"])
    own = table[~table["kind"].isin(PLANTED)]
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
        method=_short(main["method"]), runs=[len(v) for v in times], hits=hits,
        missed=missed, **{name: np.where(missed, np.nan, values) for name, values in spent.items()},
    )  # fmt: skip
    frame["reached"] = [f"{h} of {n}" for h, n in zip(frame["hits"], frame["runs"], strict=True)]
    return frame.reset_index(drop=True)


def _short(methods: pd.Series) -> list[str]:
    """Return methods without their settings, where the names stay distinct."""
    plain = {method: method.partition("[")[0] for method in methods.unique()}
    repeated = {name for name in plain.values() if list(plain.values()).count(name) > 1}
    return [method if plain[method] in repeated else plain[method] for method in methods]


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
    shown = known.drop(columns="missed")
    return [Table("reached", wide, columns, title, NOTES, terminal=True, page=True, data=shown)]


def chart(known: pd.DataFrame) -> Chart:
    """Return what each method takes on each problem, a row per problem."""
    methods = list(
        dict.fromkeys(known.sort_values("kind", key=lambda kinds: kinds == COSTS_ONLY, kind="stable")["method"])
    )
    looks = {
        method: Style(PALETTE[i % len(PALETTE)], MARKERS[i % len(MARKERS)], "none") for i, method in enumerate(methods)
    }
    return Chart(
        "reached", known, [EVALUATIONS],
        [text("problem", label="")], "dots", series="method", styles=looks, failed="missed", height=0.55,
        subtitle=f"To 1/{MAIN:g} of the first regret, each method at its best rate. Cross: most searches miss it",
        text="A dot is the median over the searches of a method and a bar their range. A gradient counts as one rollout.",
    )  # fmt: skip
