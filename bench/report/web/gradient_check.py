"""The page of the gradient checks: verdicts, and errors against the step of the differences."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from bench.gradcheck import FAULTS, VERDICTS
from bench.grid import Experiment
from bench.report.gradient_check import by_point, long_table
from bench.report.style import PALETTE
from bench.report.views import number
from bench.report.web.content import STATUS, Axis, Chart, Column, Content, counted, identity_columns, look, titled

POINTS = {"start": 0, "before": 5, "at": 2, "after": 3}
"""Places in the palette of the points at which gradients are checked."""


def content(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> Content:
    """The verdicts, and every error against eps."""
    chart = Chart(
        "Error against the step of the differences",
        "A right gradient falls with eps^2 until rounding takes over; one that is wrong stays on a level.",
        [Axis("eps", "eps, in units of the natural scale")],
        [Axis("relative_error", "relative error", above_one="larger than the gradient")],
        table="checks",
        facet="problem",
        line="line",
    )
    return Content(
        finding=finding(rows),
        rows=rows.assign(series=rows["verdict"]),
        columns=[
            *identity_columns(rows),
            Column("verdict", "verdict", "text"),
            Column("best_error", "best error"),
            Column("best_eps", "at eps"),
            *STATUS,
        ],
        charts=[chart],
        answers=answers(rows),
        answers_title="Verdicts",
        tables={"checks": checks(rows)},
        looks={
            point: look(PALETTE[place], symbol)
            for (point, place), symbol in zip(
                POINTS.items(), ("circle", "square", "diamond", "triangle-up"), strict=True
            )
        },
    )


def checks(rows: pd.DataFrame) -> pd.DataFrame:
    """A line per check and eps."""
    long = long_table(rows)
    long = long[long["eps"].notna()]
    place = pd.Series(range(len(rows)), index=rows["key"])
    line = titled(long, ["point", "sample", "direction", "horizon", "stiffness"])
    return pd.DataFrame(
        {
            "row": long["key"].map(place),
            "problem": titled(long, ["scene", "contact", "integrator", "backend"]),
            "series": long["point"],
            "line": line,
            "eps": long["eps"].astype(float),
            "relative_error": long["relative_error"].astype(float),
        }
    ).reset_index(drop=True)


def finding(rows: pd.DataFrame) -> str:
    """How many checks found a fault, and where."""
    found = by_point(rows)
    faults = found[found["verdict"].isin(FAULTS)]
    if found.empty:
        return "No gradient could be checked: the table has the reason of each cell."
    if faults.empty:
        return f"None of {counted(len(found), 'checked point')} shows a wrong gradient{_told(found)}."
    named = ", ".join(dict.fromkeys(titled(faults, ["scene", "contact", "backend"])))
    return f"{len(faults)} of {counted(len(found), 'checked point')} show a fault: {', '.join(faults['verdict'].unique())}; on {named}."


def _told(found: pd.DataFrame) -> str:
    """The largest error where there is a derivative, and how many points have none."""
    broken = found["verdict"].isin(("kink", "jump", "unsettled"))
    errors = found.loc[~broken, "error"].dropna()
    told = (
        f"; the largest error is {number(errors.max())} ({found.loc[errors.idxmax(), 'scene']})" if len(errors) else ""
    )
    if broken.any():
        scenes = ", ".join(dict.fromkeys(found.loc[broken, "scene"]))
        told += f"; {broken.sum()} of them lie on a kink or a jump, where a gradient can be of one side only ({scenes})"
    return told


def answers(rows: pd.DataFrame) -> pd.DataFrame:
    """How many points have each verdict, and on which scenes."""
    found = by_point(rows)
    lines = []
    for verdict in VERDICTS:
        part = found[found["verdict"] == verdict]
        if len(part):
            fault = "yes" if verdict in FAULTS else "no"
            scenes = ", ".join(dict.fromkeys(part["scene"]))
            largest = number(part["error"].max())
            lines.append(
                {"verdict": verdict, "fault": fault, "points": len(part), "largest error": largest, "scenes": scenes}
            )
    return pd.DataFrame(lines)
