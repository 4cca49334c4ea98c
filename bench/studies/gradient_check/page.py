"""The page of the gradient checks: verdicts, and errors against the step of the differences."""

from __future__ import annotations

import pandas as pd

from bench.experiment.experiment import Experiment
from bench.measure.gradcheck import UNTRUSTED, VERDICTS
from bench.report.style import PALETTE
from bench.report.text import counted, number
from bench.report.views import Arranged, arranged
from bench.report.web.content import (
    STATUS,
    Chart,
    Content,
    PlotAxis,
    TableColumn,
    identity_columns,
    look,
    problems,
    titled,
    together,
)
from bench.studies.gradient_check.report import PROBLEM, by_point, doubtful, long_table

POINTS = {"start": 0, "before": 5, "at": 2, "after": 3}
"""Colours, as places in the palette, of the points at which gradients are checked."""


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the verdicts, and every error against eps."""
    shown = arranged(experiment, rows)
    chart = Chart(
        "Error against the step of the differences",
        "A right gradient falls with eps^2 until rounding takes over; one that is wrong stays on a level.",
        [PlotAxis("eps", "eps, in units of the natural scale")],
        [PlotAxis("relative_error", "relative error", above_one="larger than the gradient")],
        table="checks",
        facet="problem",
        line="line",
    )
    return Content(
        finding=finding(rows),
        rows=shown.rows.assign(series=rows["verdict"]),
        columns=[
            *identity_columns(shown.rows, [axis.column for axis in shown.axes]),
            TableColumn("verdict", "verdict", "text"),
            TableColumn("best_error", "best error"),
            TableColumn("best_eps", "at eps"),
            *STATUS,
        ],
        charts=[chart],
        answers=answers(rows),
        answers_title="Verdicts",
        tables={"checks": checks(shown)},
        looks={
            point: look(PALETTE[place], symbol)
            for (point, place), symbol in zip(
                POINTS.items(), ("circle", "square", "diamond", "triangle-up"), strict=True
            )
        },
    )


def checks(shown: Arranged) -> pd.DataFrame:
    """Return a line per check and eps."""
    parts = [*PROBLEM, "backend"]
    rows = shown.rows.assign(
        row=range(len(shown.rows)),
        problem=problems(shown, parts, together(shown, "horizon"), parts),
        cell=problems(shown, ["scene"], always=["horizon"]),
    )
    long = long_table(rows)
    long = long[long["eps"].notna()]
    return pd.DataFrame(
        {
            "row": long["row"].astype(int),
            "problem": long["problem"],
            "series": long["point"],
            "line": titled(long, ["point", "sample", "direction", "cell"]),
            "eps": long["eps"].astype(float),
            "relative_error": long["relative_error"].astype(float),
        }
    ).reset_index(drop=True)


def finding(rows: pd.DataFrame) -> str:
    """Write how many checks found a fault, and where."""
    points = by_point(rows)
    faults = doubtful(points)
    if points.empty:
        return "No gradient could be checked: the table has the reason of each cell."
    if faults.empty:
        return (
            f"None of {counted(len(points), 'checked point')} shows a gradient that cannot be trusted{_errors(points)}."
        )
    named = ", ".join(dict.fromkeys(titled(faults, ["scene", "contact", "backend"])))
    kinds, show = ", ".join(faults["verdict"].unique()), "shows" if len(faults) == 1 else "show"
    return f"{len(faults)} of {counted(len(points), 'checked point')} {show} a gradient that cannot be trusted: {kinds}; on {named}."


def _errors(points: pd.DataFrame) -> str:
    """Write the largest error where there is a derivative, and how many points have none."""
    broken = points["verdict"].isin(UNTRUSTED)
    errors = points.loc[~broken, "error"].dropna()
    text = (
        f"; the largest error is {number(errors.max())} ({points.loc[errors.idxmax(), 'scene']})" if len(errors) else ""
    )
    if broken.any():
        scenes = ", ".join(dict.fromkeys(points.loc[broken, "scene"]))
        lies = "lies" if broken.sum() == 1 else "lie"
        text += (
            f"; {broken.sum()} of them {lies} on a kink or a jump, where a gradient can be of one side only ({scenes})"
        )
    return text


def answers(rows: pd.DataFrame) -> pd.DataFrame:
    """Return how many points have each verdict, and on which scenes."""
    points = by_point(rows)
    lines = []
    for verdict in VERDICTS:
        part = points[points["verdict"] == verdict]
        if len(part):
            fault = "yes" if doubtful(part).empty else "no"
            scenes = ", ".join(dict.fromkeys(part["scene"]))
            largest = number(part["error"].max())
            lines.append(
                {"verdict": verdict, "trusted": fault, "points": len(part), "largest error": largest, "scenes": scenes}
            )
    return pd.DataFrame(lines)
