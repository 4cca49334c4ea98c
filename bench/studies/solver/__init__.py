"""How a gradient depends on the iterations of an engine's constraint solver: its error to the converged program."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, ComparisonRule, numbers
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.study import Study
from bench.experiment.views import Views
from bench.model import param
from bench.model.parameters import values

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Solver(Study):
    """Measures the error of a gradient to the gradient of the program with a converged constraint solver, and its time."""

    name = "solver"
    axes: ClassVar[tuple[str, ...]] = ("scene", "contact", "integrator", "backend")
    columns: ClassVar[Columns] = Columns.of(
        Column("iterations", "maximum iterations of the constraint solver"),
        Column("gradient_norm", "norm of the gradient"),
        Column("converged_norm", "norm of the converged program's gradient"),
        Column("gradient_error_rel", "norm of (gradient - converged program's gradient) / converged_norm", label="error, relative",
               comparison=ComparisonRule("exact", "error of the gradient")),
        Column("gradient_cosine", "cosine between the gradient and the converged program's gradient", label="cosine"),
        Column("wrong_signs", "share of coordinates whose sign is not that of the converged program's gradient", label="wrong signs",
               comparison=ComparisonRule("exact", "wrong signs")),
        Column("gradient_s", "time of the gradients of `samples` rollouts", "s", measured=True, label="gradients", format="seconds"),
        Column("compile_s", "time of compiling the gradient", "s", measured=True, label="compilation", format="seconds"),
        numbers("gradient", "gradient at w = 0, by coordinate of theta"),
        numbers("converged_gradient", "the converged program's gradient at w = 0, by coordinate of theta"),
    )  # fmt: skip
    timed: ClassVar[bool] = True

    converged: int = param(100, "iterations of the program that counts as converged", positive=True)
    timed_calls: int = param(5, "calls timed", positive=True)

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column: errors to the converged program at w = 0, and the time of gradients [s]."""
        from bench.studies.solver.measure import measure

        return measure(cell, session, self.converged, self.timed_calls)

    def unsupported_reason(self, cell: Cell) -> str | None:
        """Return that the backend has no constraint solver whose iterations are a parameter, or None."""
        if "iterations" in values(cell.backend):
            return None
        return f"backend {cell.backend.name} has no parameter iterations, the iterations of a constraint solver"

    def views(self, experiment: Experiment, rows: pd.DataFrame) -> Views:
        """Return the table of errors and times, and the chart of errors along the iterations."""
        from bench.studies.solver.views import views

        return views(experiment, rows)
