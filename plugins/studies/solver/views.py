"""What the study of the solver shows: the error of gradients along the iterations of an engine's constraint solver."""

from __future__ import annotations

import pandas as pd

from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Mark, Views
from bench.report.shown import Shown, floored

FLOOR = 1e-16
"""Smallest relative error that is drawn; smaller ones, 0 included, are drawn here as upper limits."""
SHOWN = ("solver_residual", "gradient_error_rel", "gradient_cosine", "wrong_signs", "gradient_s", "compile_s")
NOTES = (
    "Gradients at theta without noise, compared with the gradient of the same program with a converged solver. The residual "
    "of the solver is relative to the forces of a step. Times are of one batch of `samples` rollouts.",
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the table with a line per scene, engine and iterations, and the chart of errors."""
    shown = Shown(experiment, rows)
    numbers = [shown.column(name, digits=3) for name in SHOWN]
    cells = shown.cells(numbers, "gradients along the iterations of the constraint solver", NOTES, ("scene", "backend"))
    iterations = shown.column("iterations", label="iterations of the solver", log=True)
    error = shown.column("gradient_error_rel", label="relative error", limit="gradient_error_rel_limit", log=True)
    chart = Chart(
        "solver", floored(shown.good, FLOOR, [error.name]), [iterations], [error], series="method", panel="problem",
        marks=[Mark("as large as the gradient", 1.0, axis="y")],
        text="The error is the distance from the gradient of the program with a converged solver.",
    )  # fmt: skip
    return Views([cells], [chart])
