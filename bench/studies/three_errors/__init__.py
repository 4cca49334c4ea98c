"""Measures program, model and estimator error of a gradient separately, and the forward error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from bench.experiment.cell import Cell
from bench.experiment.columns import Columns
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.study import Study
from bench.experiment.views import Views
from bench.studies.three_errors.columns import COLUMNS

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ThreeErrors(Study):
    """Measures program, model and estimator error of a gradient, and the forward error."""

    name = "three_errors"
    columns: ClassVar[Columns] = COLUMNS

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column: forward, program and model error at w = 0, and the estimator's bias."""
        from bench.studies.three_errors.measure import measure

        return measure(cell, session)

    def views(self, experiment: Experiment, rows: pd.DataFrame) -> Views:
        """Return the tables and the charts of the errors."""
        from bench.studies.three_errors.views import views

        return views(experiment, rows)
