"""Bias, variance and cost of estimators against the certified gradient: the main study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from bench.experiment.cell import Cell
from bench.experiment.columns import Columns
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.study import Study
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

    def write(self, experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
        """Write the main table, error against time, the charts, the cost to reach each error, and the ranking."""
        from bench.studies.bias_variance import charts, ranking, tables, time_to_accuracy

        paths = tables.write(experiment, rows) + charts.write(experiment, rows)
        return paths + time_to_accuracy.write(experiment, rows) + ranking.write(experiment, rows)

    def show(self, experiment: Experiment, rows: pd.DataFrame) -> None:
        """Print the main table (condensed if long), the findings, the diagnostics, and the cost to reach each error."""
        from bench.studies.bias_variance import reported, terminal, time_to_accuracy

        terminal.show(experiment, rows)
        reported.show(rows)
        time_to_accuracy.show(experiment, rows)

    def page(self, experiment: Experiment, rows: pd.DataFrame) -> Any:
        """Return the page: the finding, the recommended estimators and the charts."""
        from bench.studies.bias_variance.page import content

        return content(experiment, rows)

    def chart(self, experiment: Experiment, rows: pd.DataFrame) -> Sequence[str]:
        """Return the names of charts in order of preference: the experiment's own, then those of its axes, longest first."""
        from bench.studies.bias_variance.charts import along_longest

        return [experiment.name, *along_longest(experiment, rows)]
