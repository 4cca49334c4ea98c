"""Builds the page of the gradient checks: verdicts, and errors against the step of the differences."""

from __future__ import annotations

import pandas as pd

from bench.experiment.experiment import Experiment
from bench.measure.gradcheck import UNTRUSTED, VERDICTS
from bench.report.problems import axes_of, problem_names
from bench.report.style import PALETTE
from bench.report.text import counted, number
from bench.report.views import Arranged, arrange
from bench.report.web.content import STATUS, Chart, Content, PlotAxis, TableColumn, identity_columns, look, titled
from bench.studies.gradient_check.points import POINTS
from bench.studies.gradient_check.report import PROBLEM, by_point, long_table, untrusted

LOOKS = {
    point: look(PALETTE[place], symbol)
    for point, place, symbol in zip(
        POINTS, (0, 5, 2, 3, 4), ("circle", "square", "diamond", "triangle-up", "x"), strict=True
    )
}
"""Colour and symbol of each point at which gradients are checked."""


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the content of the page: the finding, the verdicts, and errors against the step of the differences."""
    shown = arrange(experiment, rows)
    chart = Chart(
        "Error against the step of the differences",
        "The error of a right gradient falls with eps^2 until rounding dominates; that of a wrong one stays constant.",
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
        looks=LOOKS,
    )


def checks(shown: Arranged) -> pd.DataFrame:
    """Return the data of the chart, one line per check and eps."""
    parts = [*PROBLEM, "backend"]
    rows = shown.rows.assign(
        row=range(len(shown.rows)),
        problem=problem_names(shown, parts, axes_of(shown, "horizon"), parts),
        cell=problem_names(shown, ["scene"], always=["horizon"]),
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
    """Format how many checked points have an untrusted gradient, with their verdicts and problems."""
    points = by_point(rows)
    faults = untrusted(points)
    if points.empty:
        return "No gradient could be checked: the table has the reason of each cell."
    if faults.empty:
        return f"No wrong gradient at {counted(len(points), 'checked point')}{_errors(points)}."
    problem_names = ", ".join(dict.fromkeys(titled(faults, ["scene", "contact", "backend"])))
    have, verdicts = "has" if len(faults) == 1 else "have", ", ".join(faults["verdict"].unique())
    return (
        f"{len(faults)} of {counted(len(points), 'checked point')} {have} a gradient that cannot be trusted "
        f"({verdicts}): {problem_names}."
    )


def _errors(points: pd.DataFrame) -> str:
    """Format the largest error of points with a derivative, and the number of points on a kink or jump."""
    broken = points["verdict"].isin(UNTRUSTED)
    errors = points.loc[~broken, "error"].dropna()
    text = (
        f"; the largest error is {number(errors.max())} ({points.loc[errors.idxmax(), 'scene']})" if len(errors) else ""
    )
    if broken.any():
        scenes = ", ".join(dict.fromkeys(points.loc[broken, "scene"]))
        points_are = "point is" if broken.sum() == 1 else "points are"
        text += f"; {broken.sum()} {points_are} on a kink or a jump, where only one-sided gradients exist ({scenes})"
    return text


def answers(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per verdict: the number of points, the largest error and the scenes."""
    points = by_point(rows)
    lines = []
    for verdict in VERDICTS:
        part = points[points["verdict"] == verdict]
        if len(part):
            lines.append({
                "verdict": verdict, "trusted": "yes" if untrusted(part).empty else "no", "points": len(part),
                "largest error": number(part["error"].max()), "scenes": ", ".join(dict.fromkeys(part["scene"])),
            })  # fmt: skip
    return pd.DataFrame(lines)
