"""How a gradient depends on the iterations of an engine's constraint solver: its error to the converged program."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, exact, numbers, seconds
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.views import Chart, Mark, Views
from bench.host.parameters import values
from bench.model import param

from . import PARTS, StudyPackage, finite_status, first_batch, gradient_seconds, norm, relative_error

if TYPE_CHECKING:
    import pandas as pd

SHOWN = ("solver_residual", "gradient_error_rel", "gradient_cosine", "wrong_signs", "gradient_s", "compile_s")
NOTES = (
    "Gradients at theta without noise, compared with the gradient of the same program with a converged solver. The residual "
    "of the solver is relative to the forces of a step. Times are of one batch of `samples` rollouts.",
)


@dataclass(frozen=True)
class Solver(StudyPackage):
    """Measures the error of a gradient to the gradient of the program with a converged constraint solver, and its time."""

    name = "solver"
    axes = PARTS
    columns = Columns.of(
        Column("iterations", "maximum iterations of the constraint solver"),
        Column("gradient_norm", "norm of the gradient"),
        Column("converged_norm", "norm of the converged program's gradient"),
        exact(
            "gradient_error_rel",
            "norm of (gradient - converged program's gradient) / converged_norm",
            "error of the gradient",
            "error, relative",
        ),
        Column("gradient_cosine", "cosine between the gradient and the converged program's gradient", label="cosine"),
        exact(
            "wrong_signs",
            "share of coordinates whose sign is not that of the converged program's gradient",
            "wrong signs",
            "wrong signs",
        ),
        seconds("gradient_s", "time of the gradients of `samples` rollouts", "gradients"),
        seconds("compile_s", "time of compiling the gradient", "compilation"),
        numbers("gradient", "gradient at w = 0, by coordinate of theta"),
        numbers("converged_gradient", "the converged program's gradient at w = 0, by coordinate of theta"),
    )
    timed = True

    converged: int = param(100, "iterations of the program that counts as converged", positive=True)
    timed_calls: int = param(5, "calls timed", positive=True)

    def refusal(self, cell: Cell) -> str | None:
        """Return that the backend has no constraint solver whose iterations are a parameter, or None."""
        if "iterations" in values(cell.backend):
            return None
        return f"backend {cell.backend.name} has no parameter iterations, the iterations of a constraint solver"

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column: errors to the converged program at w = 0, and times [s]."""
        backend: Any = cell.backend
        problem, limit = session.problem(cell), session.problems.of(replace(backend, iterations=self.converged), cell)
        w = first_batch(cell, problem.program.n_noise)
        # both batches have the same shape, so that each program is compiled once
        gradient, target = (one.grad(problem.program.theta0, np.zeros_like(w))[:, 0] for one in (problem, limit))
        # a coordinate of the converged gradient below this share of its norm has no sign
        has_sign = np.abs(target) > 1e-6 * norm(target)
        return {
            **finite_status("a gradient is not finite", gradient, target),
            "iterations": backend.iterations,
            "gradient": gradient.tolist(),
            "converged_gradient": target.tolist(),
            **gradient_seconds(problem, w, self.timed_calls),
            "gradient_norm": norm(gradient),
            "converged_norm": norm(target),
            "gradient_error_rel": relative_error(gradient, target),
            "gradient_cosine": float(gradient @ target) / (norm(gradient) * norm(target)),
            "wrong_signs": float((np.sign(gradient) != np.sign(target))[has_sign].mean()),
        }

    def show(self, experiment: Experiment, rows: pd.DataFrame) -> Views:
        """Return the table with a line per scene, engine and iterations, and the chart of errors."""
        from bench.report.shown import Shown

        shown = Shown(experiment, rows)
        cells = shown.cells(
            SHOWN, "gradients along the iterations of the constraint solver", NOTES, ("scene", "backend")
        )
        iterations = shown.column("iterations", label="iterations of the solver", format="setting", log=True)
        error = shown.column("gradient_error_rel", label="relative error", least=1e-6, log=True)
        fewer = shown.good[shown.good["iterations"] < self.converged]  # a converged program has no error to itself
        chart = Chart(
            "solver",
            fewer,
            [iterations],
            [error],
            series="method",
            panel="problem",
            marks=[Mark("as large as the gradient", 1.0, axis="y")],
            subtitle=f"against the gradient of the same program after {self.converged} iterations",
        )
        return Views([cells], [chart])
