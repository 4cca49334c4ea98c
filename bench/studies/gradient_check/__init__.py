"""Is the program's gradient the derivative of its cost, away from contact switches and on both sides of one?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, text
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.study import Study
from bench.measure.gradcheck import VERDICTS
from bench.model import param

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class GradientCheck(Study):
    """Checks the program's gradient against differences of its cost, at the start and around a contact switch."""

    name = "gradient_check"
    columns: ClassVar[Columns] = Columns.of(
        Column("untrusted", "number of checks that show a gradient not to be trusted"),
        Column("best_error", "smallest relative error over all steps, of the worst check"),
        Column("best_eps", "step of that error, in units of the natural scale"),
        Column("scale", "natural scale of displacements of theta: its norm, at least 1"),
        Column(
            "taylor_order", "order of the Taylor remainder along random directions: 2 for a right gradient, 1 if wrong"
        ),
        Column("cost_noise", "measured standard deviation of the cost's own noise"),
        text(
            "verdict",
            "the worst verdict of the checks",
            comparison=ComparisonRule("verdict", "verdict", order=VERDICTS),
        ),
        text("command", "a line for the shell that repeats the checks"),
        text("device", "what the program ran on"),
        numbers("component", "components of theta that were checked one by one"),
        numbers("component_program", "of each component, the program's number"),
        numbers("component_difference", "of each component, what the differences settle on"),
        numbers("component_uncertainty", "of each component, the error of that"),
        numbers("component_step", "of each component, the step it was taken at, in units of the component"),
        numbers("component_ratio", "of each component, the program's number over the difference"),
        numbers("component_left", "of each component, the one-sided slope towards smaller values"),
        numbers("component_right", "of each component, the one-sided slope towards larger values"),
        numbers("component_verdict", "of each component, its verdict"),
        numbers("point", "where each check was made: start, or before, at or after a contact switch"),
        numbers("sample", "of each check, 0 without noise, 1 with it"),
        numbers("direction", "of each check, the number of its direction; -1 - i for component i"),
        numbers("derivative_program", "of each check, the program's directional derivative"),
        numbers("check_verdict", "of each check, its verdict"),
        numbers("check_error", "of each check, the smallest relative error over all steps"),
        numbers("check_eps", "of each check, the step of that error"),
        numbers("eps", "the steps of the differences, in units of the scale"),
        numbers("derivative_differences", "of each check and step, the central difference"),
        numbers("relative_error", "of each check and step, its relative error"),
        numbers("mode_minus", "of each check and step, the contact mode on the minus side"),
        numbers("mode_plus", "of each check and step, the contact mode on the plus side"),
    )

    directions: int = param(2, "directions of the checks at the start, and of those at a switch", positive=True)
    drawn: int = param(16, "directions along which a contact switch is looked for", positive=True)
    reach: float = param(
        2.0, "how far along a direction a switch is looked for, in units of the scale of theta", positive=True
    )
    aside: float = param(
        1e-4, "how far before and after a switch gradients are checked, in the same units", positive=True
    )

    around: int = param(8, "other thetas around the start at which gradients are checked", low=1)

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Make all checks of one cell."""
        from bench.studies.gradient_check.measure import SwitchSearch, measure

        return measure(cell, session, SwitchSearch(self.directions, self.drawn, self.reach, self.aside, self.around))

    def write(self, experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
        """Write the tables and the matrix of verdicts."""
        from bench.studies.gradient_check import matrix, report

        return [*report.write(experiment, rows), *matrix.write(experiment, rows)]

    def show(self, experiment: Experiment, rows: pd.DataFrame) -> None:
        """Print the counts of verdicts and every fault."""
        from bench.studies.gradient_check import report

        report.show(experiment, rows)

    def page(self, experiment: Experiment, rows: pd.DataFrame) -> Any:
        """Return the finding, its table and the charts."""
        from bench.studies.gradient_check.page import content

        return content(experiment, rows)

    def faults(self, rows: pd.DataFrame) -> int:
        """Count rows on which a check found a gradient that cannot be trusted, or no finite cost."""
        return int(((rows["untrusted"] > 0) | (rows["status"] == "nonfinite")).sum())
