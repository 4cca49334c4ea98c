"""What the study of the solver shows: the error of gradients along the iterations of an engine's constraint solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Mark, Views
from bench.report.generic import engine_table
from bench.report.problems import problem_names
from bench.report.text import counted, number
from bench.report.views import arrange
from bench.report.writer import reasons

FLOOR = 1e-16
"""Smallest relative error that is drawn; smaller ones, 0 included, are drawn here as upper limits."""
CONVERGED = 1e-6
"""Relative error up to which a gradient counts as that of the converged program."""
SHOWN = ("gradient_error_rel", "gradient_cosine", "wrong_signs", "gradient_s", "compile_s")
NOTES = (
    "Gradients at theta without noise, compared with the gradient of the same program with a converged solver. The residual "
    "of the solver is relative to the forces of a step. Times are of one batch of `samples` rollouts.",
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the findings, the table with a line per scene, engine and iterations, and the chart of errors."""
    arranged = arrange(experiment, rows)
    known = experiment.columns.by_name
    own = [replace(known[name], digits=3) for name in ("solver_residual", *SHOWN)]
    title = "gradients along the iterations of the constraint solver"
    lines = engine_table(experiment, rows, arranged, own, title, NOTES, always=("scene", "backend"))
    good = arranged.rows[arranged.rows["status"] == "ok"]
    if good.empty:
        return Views(["No cell gave a result: the table has the reason of each."], [lines], remarks=reasons(rows))
    good = good.assign(
        problem=problem_names(arranged, ["scene", "contact", "integrator"], always=["scene"], rows=good),
        engine=problem_names(arranged, ["backend"], arranged.axes, always=["backend"], rows=good),
    )
    findings = [errors(good), iterations(good)]
    return Views(findings, [lines], [_chart(experiment, good, findings[0])], remarks=reasons(rows))


def errors(good: pd.DataFrame) -> str:
    """Return on how many problems the fewest iterations give a gradient with a wrong sign, and the largest error."""
    fewest = good[good["iterations"] == good["iterations"].min()]
    wrong = fewest.groupby("problem", sort=False)["wrong_signs"].max() > 0
    worst = fewest.loc[fewest["gradient_error_rel"].idxmax()]
    count = counted(int(worst["iterations"]), "solver iteration")
    return (
        f"With {count} gradients have wrong signs on {int(wrong.sum())} of {counted(len(wrong), 'problem')}, and a "
        f"relative error of up to {number(worst['gradient_error_rel'])} ({worst['problem']})."
    )


def iterations(good: pd.DataFrame) -> str:
    """Return the fewest iterations from which on all gradients equal the converged program's, by problem."""
    texts = []
    for problem, part in good.groupby("problem", sort=False):
        above = part[part["gradient_error_rel"] > CONVERGED]["iterations"]
        enough = part[part["iterations"] > (above.max() if len(above) else 0)]["iterations"]
        texts.append(f"{problem} {f'{enough.min():g}' if len(enough) else 'more than measured'}")
    return f"Measured iterations from which on the error is below {number(CONVERGED, 1)}: {', '.join(texts)}."


def _chart(experiment: Experiment, good: pd.DataFrame, title: str) -> Chart:
    """Return the chart of the relative error along the iterations, a panel per problem and a line per engine."""
    error = good["gradient_error_rel"]
    frame = good.assign(
        row=good.index, gradient_error_rel=np.maximum(error, FLOOR), gradient_error_rel_limit=error < FLOOR
    )
    columns = experiment.columns.by_name
    return Chart(
        "solver", title, frame,
        [replace(columns["iterations"], label="iterations of the solver", log=True)],
        [replace(columns["gradient_error_rel"], label="relative error", limit="gradient_error_rel_limit", log=True)],
        series="engine", panel="problem", marks=[Mark("as large as the gradient", 1.0, axis="y")],
        text="The error is the distance from the gradient of the program with a converged solver.",
    )  # fmt: skip
