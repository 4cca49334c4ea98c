"""What the study of twins shows: how far each engine is from the scene's own program, and the time of its gradients."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd

from bench.experiment.columns import Column
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Mark, Style, Views
from bench.report.generic import engine_table
from bench.report.problems import problem_names
from bench.report.style import PALETTE
from bench.report.text import counted, duration, number
from bench.report.views import arrange
from bench.report.writer import reasons

FLOOR = 1e-17
"""Smallest difference that is drawn; smaller ones, 0 included, are drawn here as upper limits."""
DIFFERENT = 1e-6
"""Relative difference above which a twin's states or gradient count as different. Accumulated rounding is smaller."""
COLOURS = (PALETTE[2], PALETTE[0], PALETTE[3], PALETTE[4])
SHOWN = (
    "state_difference", "state_difference_rel", "cost_difference_rel", "gradient_difference_rel", "gradient_cosine",
    "value_s", "gradient_s", "compile_s",
)  # fmt: skip
NOTES = (
    "Differences between the engine's twin and the scene's own program at theta without noise. Difference of states: the "
    "largest over the rollout; relative: in units of the coordinate's largest value. Times are of one batch of `samples` "
    "rollouts; compilation is of the gradient.",
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the finding, the table with a line per scene and engine, and the chart of differences."""
    shown = arrange(experiment, rows)
    own = [replace(experiment.columns.by_name[name], digits=3) for name in SHOWN]
    lines = engine_table(experiment, rows, shown, own, "engines compared with the scenes' own programs", NOTES)
    good = shown.rows[shown.rows["status"] == "ok"]
    if good.empty:
        return Views(["No cell gave a result: the table has the reason of each."], [lines], remarks=reasons(rows))
    good = good.assign(
        problem=problem_names(shown, ["scene", "contact", "integrator"], always=["scene"], rows=good),
        engine=problem_names(shown, ["backend"], always=["backend"], rows=good),
    )
    findings = [*agreement(good), *speed(good)]
    return Views(findings, [lines], [_chart(experiment, good, findings[0])], remarks=reasons(rows))


def agreement(good: pd.DataFrame) -> list[str]:
    """Return on how many problems the engines agree with the scenes' own programs, and where they differ most."""
    states, gradients = (
        good.groupby("problem", sort=False)[f"{name}_difference_rel"].max(skipna=False)
        for name in ("state", "gradient")
    )
    same = int(((states <= DIFFERENT) & (gradients <= DIFFERENT)).sum())
    engines = " and ".join(dict.fromkeys(good["engine"]))
    texts = [
        f"{engines} agree with the states and the gradient of the scene's own program within {number(DIFFERENT, 1)} on "
        f"{same} of {counted(len(states), 'problem')}."
    ]
    if same < len(states):
        place = good.loc[good["gradient_difference_rel"].idxmax()]
        texts.append(
            f"The largest difference is on {place['problem']}: {number(states[place['problem']])} of the states and "
            f"{number(place['gradient_difference_rel'])} of the gradient."
        )
    return texts


def speed(good: pd.DataFrame) -> list[str]:
    """Return the times of one batch of gradients by engine."""
    texts = []
    for engine, part in good.groupby("engine", sort=False):
        compiled = part["compile_s"].max()
        after = f" after up to {duration(compiled)} of compilation" if compiled > 0 else ""
        texts.append(f"{engine} {duration(part['gradient_s'].min())} to {duration(part['gradient_s'].max())}{after}")
    counts = " or ".join(f"{count:g}" for count in good["samples"].unique())
    return [f"{counts} gradients take: {', '.join(texts)}."] if texts else []


def _chart(experiment: Experiment, good: pd.DataFrame, title: str) -> Chart:
    """Return the dot plot of the differences, the largest first."""
    order = good.groupby("problem")["gradient_difference_rel"].max().sort_values(ascending=False).index
    frame = good.assign(row=good.index).set_index("problem").loc[order].reset_index()
    names = ("gradient_difference_rel", "state_difference_rel", "cost_difference_rel")
    labels = ("relative difference of the gradient", "relative difference of states", "relative difference of costs")
    frame = frame.assign(
        **{f"{name}_limit": frame[name] < FLOOR for name in names},
        **{name: frame[name].clip(lower=FLOOR) for name in names},
    )
    x = [
        replace(experiment.columns.by_name[name], label=label, limit=f"{name}_limit", log=True)
        for name, label in zip(names, labels, strict=True)
    ]
    engines = list(dict.fromkeys(frame["engine"]))
    styles = {engine: Style(COLOURS[i % 4], "oD^v"[i % 4]) for i, engine in enumerate(engines)}
    return Chart(
        "twins", title, frame, x, [Column("problem", kind="text", label="")], "dots", series="engine", styles=styles,
        marks=[Mark("rounding up to here", DIFFERENT)], height=0.3,
        text="One dot per problem and engine. Left of the dashed line a difference is accumulated rounding.",
    )  # fmt: skip
