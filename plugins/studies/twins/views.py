"""What the study of twins shows: how far each engine is from the scene's own program, and the time of its gradients."""

from __future__ import annotations

import pandas as pd

from bench.experiment.columns import text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Mark, Views
from bench.report.shown import Shown, floored

FLOOR = 1e-17
"""Smallest difference that is drawn; smaller ones, 0 included, are drawn here as upper limits."""
ROUNDING = 1e-6
"""Relative difference above which a twin's states or gradient count as different. Accumulated rounding is smaller."""
DIFFERENCES = ("gradient_difference_rel", "state_difference_rel", "cost_difference_rel")
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
    """Return the table with a line per scene and engine, and the chart of differences, the largest first."""
    shown = Shown(experiment, rows)
    numbers = [shown.column(name, digits=3) for name in SHOWN]
    cells = shown.cells(numbers, "engines compared with the scenes' own programs", NOTES)
    worst = shown.good.groupby("problem")["gradient_difference_rel"].transform("max")
    frame = floored(shown.good.loc[worst.sort_values(ascending=False, kind="stable").index], FLOOR, DIFFERENCES)
    chart = Chart(
        "twins", frame, [shown.column(name, limit=f"{name}_limit", log=True) for name in DIFFERENCES],
        [text("problem", label="")], "dots", series="method", marks=[Mark("rounding up to here", ROUNDING)], height=0.3,
        text="One dot per problem and engine. Left of the dashed line a difference is accumulated rounding.",
    )  # fmt: skip
    return Views([cells], [chart])
