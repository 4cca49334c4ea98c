"""How gradients grow with the horizon: their norm, the product of the step Jacobians, and the variance."""

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
from bench.studies.growth.columns import COLUMNS

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Growth(Study):
    """Measures norms of sampled gradients, products of step Jacobians, and variances of first- and zeroth-order terms."""

    name = "growth"
    columns: ClassVar[Columns] = COLUMNS

    rollouts: int = param(
        64, "rollouts whose step Jacobians are multiplied: rates are known to 1/8 of their spread", low=2
    )
    lags: int = param(40, "most lags whose gain is stored", positive=True)

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column: gradient norms, variances, and growth of the Jacobian product."""
        from bench.studies.growth.measure import measure

        return measure(cell, session, self.rollouts, self.lags)

    def views(self, experiment: Experiment, rows: pd.DataFrame) -> Views:
        """Return the tables of verdicts and cells, and the charts."""
        from bench.studies.growth.views import views

        return views(experiment, rows)
