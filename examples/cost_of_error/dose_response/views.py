"""What the study of errors shows: ratios of updates and rollouts on the same problem, the cost of an error, and methods."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd

from bench.experiment.axes import table as csv_table
from bench.experiment.columns import Column, interval, setting, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Mark, Style, Table, Views
from bench.report.names import short_names
from bench.report.style import PALETTE

from . import analysis
from .analysis import BEST, MAIN

VERDICTS = {
    "above 1": Style(PALETTE[2], "D", meaning="takes more for certain"),
    "below 1": Style(PALETTE[0], "s", meaning="takes fewer for certain"),
    "not known": Style("#767676", meaning="not known: the interval includes 1"),
}
CLASS = text("scene_class", label="class")
PAIRS = (
    CLASS,
    text("comparison"),
    setting("problems"),
    setting("scenes"),
    setting("above", label="above 1"),
    interval("ratio", boundary=1.0),
    text("verdict"),
)
PANELS = {
    r"((?:random error|bias) [\d.]+)": "updates with an error of this size / with the best gradient",
    r"(\w+) / best gradient": "updates with an estimator at its best setting / with the best gradient",
    r"first order / zeroth order, gradient (.*)": "rollouts with first order / with zeroth order, where a gradient counts as so many",
    r"fewest samples / others, (.*)": "rollouts with the fewest samples / with any others",
    r"(.*) / .*, equal error": "updates with an estimator / with a random error of the same size",
    r"(.* / .*)": "updates with one error / with the other",
    r"(.*)": "updates at a wrong rate / at the best rate",
}
"""Headings of the ratios by what they compare, the first pattern that matches."""
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
        Table(
            "pairs", together, PAIRS[1:], "Ratios on the same problem", PAIR_NOTES, terminal=True, page=True, data=pairs
        ),
        Table(
            "pairs",
            main[(main["scene_class"] != analysis.ALL) & several],
            PAIRS,
            "Ratios by class",
            PAIR_NOTES,
            page=True,
            split="scene_class",
        ),
        Table("dose_response", csv_table(experiment, rows)),
        _problems(table),
    ]
    charts = [_ratios(together, experiment.answer)] if len(together) else []
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
    columns = [
        text("problem"),
        CLASS,
        *(Column(n, label=n.replace("floor_", "1/")) for n in names),
        text("reason_100", label="left out at 1/100"),
    ]
    return Table("problems", frame, columns, "Problems", PROBLEM_NOTES)


def _ratios(pairs: pd.DataFrame, answer: str) -> Chart:
    """Return the ratios: a row per comparison, in panels, that of the experiment's answer first; an interval reaches the edge where it has no end."""
    places = [
        next((heading, found[1]) for pattern, heading in PANELS.items() if (found := re.fullmatch(pattern, name)))
        for name in pairs["comparison"]
    ]
    frame = pairs.assign(
        is_missed=pairs["ratio"].isin((0.0, np.inf)),
        panel=[heading for heading, _ in places],
        row=[row for _, row in places] + pairs["scenes"].map(" ({})".format),
    )
    asked = frame.loc[[f'"{name}"' in answer for name in pairs["comparison"]], "panel"]
    return Chart(
        "ratios",
        frame.sort_values("panel", key=lambda panel: ~panel.isin(asked), kind="stable"),
        [interval("ratio", log=True)],
        [text("row", label="")],
        "dots",
        series="verdict",
        panel="panel",
        across=1,
        styles=VERDICTS,
        marks=[Mark("the same", 1.0)],
        failed="is_missed",
        failed_name="infinite or 0: most scenes miss the target",
        subtitle=f"searches to 1/{MAIN:g} of the first regret, errors relative to the gradient; median over scenes, whose number is in brackets",
    )


def _reached(known: pd.DataFrame) -> Table:
    """Return what each method takes on each problem: a row per problem, and a file with a line per problem and method."""
    wide = known.pivot(index=["problem", "scene_class"], columns="method", values="evaluations")
    order = known.set_index(["problem", "scene_class"]).index.drop_duplicates()
    wide = wide.loc[order, list(dict.fromkeys(known["method"]))].reset_index()
    columns = [text("problem"), CLASS, *(Column(name, label=name) for name in wide.columns[2:])]
    return Table(
        "reached",
        wide,
        columns,
        "Rollouts and gradients to 1/100 of the first regret",
        REACHED_NOTES,
        terminal=True,
        page=True,
        data=known.drop(columns="missed"),
    )


def _reached_chart(known: pd.DataFrame) -> Chart:
    best = Style("#767676", meaning=f"{BEST}: without noise; where the cost jumps, a mean of rollouts")
    most = known.groupby("problem")["rollouts_per_update"].transform("max")
    names = known["problem"].map(short_names(known["problem"])) + most.map(" ({:,.0f})".format)
    return Chart(
        "reached",
        known.assign(problem=names),
        [
            Column(
                "evaluations",
                label="rollouts and gradients to 1/100",
                low="fewest",
                high="most",
                ends="range of the searches",
                log=True,
            )
        ],
        [text("problem", label="")],
        "dots",
        series="method",
        styles={BEST: best},
        failed="missed",
        failed_name="most searches miss it",
        subtitle=f"to 1/{MAIN:g} of the first regret at each method's best rate, median of searches, a gradient counted as a rollout; in brackets the rollouts of an update without gradients",
    )
