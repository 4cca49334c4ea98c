"""What the study of errors shows: ratios of updates and rollouts on the same problem, the cost of an error, and methods."""

from __future__ import annotations

import numpy as np
import pandas as pd

from bench.experiment.axes import table as csv_table
from bench.experiment.columns import Column, interval, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Mark, Style, Table, Views
from bench.report.colours import method_styles
from bench.report.style import PALETTE
from bench.report.text import counted

from . import analysis
from .analysis import BEST, BIAS, COSTS_ONLY, MAIN, RANDOM

STYLES = {
    RANDOM: Style(PALETTE[0], "o"),
    BIAS: Style(PALETTE[2], "^"),
}
"""The errors that are drawn; the tables have the others and the natural methods."""
NO_VERDICT = Style("#767676")
VERDICTS = {"above 1": Style(PALETTE[2]), "below 1": Style(PALETTE[0]), "not known": NO_VERDICT}
ENOUGH = 6
"""Fewest scenes with an interval."""
CLASS, PROBLEMS, SCENES = (
    text("scene_class", label="class"),
    Column("problems", format="setting"),
    Column("scenes", format="setting"),
)
PAIRS = (
    CLASS, text("comparison"), PROBLEMS, SCENES, Column("above", label="above 1", format="setting"),
    interval("ratio", boundary=1.0), text("verdict"),
)  # fmt: skip
PAIR_NOTES = (
    "Ratios of updates, or of rollouts between orders and samples, on the same problem, to 1/100 of the first regret. One size: over "
    "the best gradient. Median over scenes, each with the median of its problems, and its 95% interval. A verdict: the exact sign "
    "test at 5%, which needs six scenes. inf: more than half miss.",
)
PROBLEM_NOTES = (
    f"Updates of the best gradient at its best rate. A problem counts for a target if these are finite and at least {analysis.LEAST_UPDATES}.",
)
REACHED_NOTES = (
    "Medians over the searches of a method: updates times the rollouts and gradients of an update, a gradient counted as one "
    "rollout. Costs and the best gradient have no noise, `fobg` has that of its samples. -: most searches miss the target.",
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the tables and charts."""
    table = analysis.searches(rows)
    if table.empty:
        return Views()
    lines, beside = analysis.counted(table), analysis.reached(table)
    pairs = analysis.by_scene(analysis.ratios(lines))
    main = pairs[pairs["target"] == MAIN]
    together = main[main["scene_class"] == analysis.ALL]
    several = table["scene_class"].nunique() > 1
    tables = [
        Table("pairs", together, PAIRS[1:], "Ratios on the same problem", PAIR_NOTES,
              terminal=True, page=True, data=pairs),
        Table("pairs", main[(main["scene_class"] != analysis.ALL) & several], PAIRS, "Ratios by class", PAIR_NOTES, page=True,
              split="scene_class"),
        Table("dose_response", csv_table(experiment, rows), [], files=["csv"]),
        _problems(table),
    ]  # fmt: skip
    points = analysis.relative_times(lines[lines["scene_class"].isin(pairs["scene_class"])])
    charts = ([_chart(points, pairs)] if several else [_ratios(together)]) if len(points) else []
    if len(beside):  # then the question is what such methods take
        tables, charts = [_reached(beside), *tables[2:]], [_reached_chart(beside)]
    return Views([one for one in tables if len(one.frame)], charts)


def _problems(table: pd.DataFrame) -> Table:
    known = analysis.floors(table)
    wide = known[known["target"].isin(analysis.SHOWN)].pivot_table(
        "floor", ["problem", "scene_class"], "target", sort=False
    )
    names = [f"floor_{target:g}" for target in wide.columns]
    reasons_of = known[known["target"] == MAIN].set_index("problem")["reason"]
    frame = wide.set_axis(names, axis=1).reset_index().assign(reason_100=lambda f: f["problem"].map(reasons_of))
    columns = [text("problem"), CLASS, *(Column(n, label=n.replace("floor_", "1/")) for n in names),
               text("reason_100", label="left out at 1/100")]  # fmt: skip
    return Table("problems", frame, columns, "Problems", PROBLEM_NOTES)


def _chart(points: pd.DataFrame, pairs: pd.DataFrame) -> Chart:
    """Return the cost of an error: updates over the best gradient's against the relative error, a panel per class."""
    points = points[points["kind"].isin(STYLES)].assign(time_low=lambda f: f["time_low"].where(f["time_low"] > 0))
    sizes = pairs[pairs["target"] == MAIN].groupby("scene_class")[["problems", "scenes"]].max()
    return Chart(
        "cost_of_error", points.sort_values("method", kind="stable"), [Column("error", label="relative error", log=True)],
        [interval("time", label="updates / best gradient's", log=True)],
        kind="points", series="method", panel="scene_class", styles=STYLES, failed="is_missed", across=3, height=2.0,
        marks=[Mark("the best gradient", 1.0, axis="y")],
        panel_notes={row.Index: f"{row.problems} problems of {counted(row.scenes, 'scene')}" + f", fewer than {ENOUGH}: no intervals" * (row.scenes < ENOUGH)
                     for row in sizes.itertuples()},
        subtitle=f"To 1/{MAIN:g} of the first regret, each method at its best rate. Cross: half of the scenes miss it. "
        "A bar to the top: no upper end",
        text="Planted errors: noise, and a bias. Medians over scenes, with 95% intervals where there are six. The error is the median over ten thetas that all methods of a problem share.",
    )  # fmt: skip


def _ratios(pairs: pd.DataFrame) -> Chart:
    """Return the ratios whose interval has an end: a row per comparison."""
    frame = pairs[(pairs["ratio_low"] > 0) | np.isfinite(pairs["ratio_high"])]
    frame = frame.assign(ratio_low=frame["ratio_low"].where(frame["ratio_low"] > 0), is_missed=np.isinf(frame["ratio"]))
    return Chart(
        "ratios", frame, [interval("ratio", label="times the updates", log=True)],
        [text("comparison", label="")], "dots", series="verdict", styles=VERDICTS, marks=[Mark("the same", 1.0)], failed="is_missed",
        height=0.28, subtitle=f"To 1/{MAIN:g} of the first regret, over the best gradient. Cross: half of the scenes miss it",
        text="Medians over scenes with 95% intervals. Left of the line is fewer updates.",
    )  # fmt: skip


def _reached(known: pd.DataFrame) -> Table:
    """Return what each method takes on each problem: a row per problem, and a file with a line per problem and method."""
    wide = known.pivot(index=["problem", "scene_class"], columns="method", values="evaluations")
    order = known.set_index(["problem", "scene_class"]).index.drop_duplicates()
    wide = wide.loc[order, list(dict.fromkeys(known["method"]))].reset_index()
    columns = [text("problem"), CLASS, *(Column(name, label=name) for name in wide.columns[2:])]
    return Table("reached", wide, columns, "Rollouts and gradients to 1/100 of the first regret", REACHED_NOTES,
                 terminal=True, page=True, data=known.drop(columns="missed"))  # fmt: skip


def _reached_chart(known: pd.DataFrame) -> Chart:
    methods = dict.fromkeys(known.sort_values("kind", key=lambda kinds: kinds == COSTS_ONLY, kind="stable")["method"])
    looks = method_styles(methods) | {BEST: NO_VERDICT}
    return Chart(
        "reached", known, [Column("evaluations", label="rollouts and gradients to 1/100", low="fewest", high="most", log=True)],
        [text("problem", label="")], "dots", series="method", styles=looks, failed="missed", height=0.55,
        subtitle=f"To 1/{MAIN:g} of the first regret, each method at its best rate. Cross: most searches miss it",
        text="Best gradient: without noise, or the mean of many costs times scores where the cost jumps. A dot is the median over the searches of a method and a bar their range. A gradient counts as one rollout.",
    )  # fmt: skip
