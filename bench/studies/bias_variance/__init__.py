"""Bias, variance and cost of estimators against the certified gradient: the main study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from bench.experiment.cell import Cell
from bench.experiment.columns import Columns
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.study import Study
from bench.experiment.views import Views
from bench.model import param
from bench.studies.bias_variance.columns import COLUMNS

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class BiasVariance(Study):
    """Measures bias and variance of estimates against the reference gradient, and the cost of an estimate."""

    name = "bias_variance"
    columns: ClassVar[Columns] = COLUMNS
    timed: ClassVar[bool] = True

    timed_calls: int = param(
        5, "estimates timed one by one on backends that do not compile; the other repeats are evaluated together",
        positive=True,
    )  # fmt: skip
    settle_s: float = param(
        0.02, "time within which calls are repeated until their interquartile range is below 10% of the median", "s",
        low=0.0,
    )  # fmt: skip

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column: statistics of its estimates, and their time."""
        from bench.studies.bias_variance.measure import measure

        return measure(cell, session, self.timed_calls, self.settle_s)

    def views(self, experiment: Experiment, rows: pd.DataFrame) -> Views:
        """Return the tables, comparisons among them, and the charts."""
        from bench.studies.bias_variance.views import views

        return views(experiment, rows)
