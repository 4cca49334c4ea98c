"""The cost of an estimate: seconds on this machine, or rollouts on any machine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from bench.report.text import axis_value, duration


@dataclass(frozen=True)
class Cost:
    """A measure of the cost of one estimate."""

    of: Callable[[pd.DataFrame], pd.Series]
    """Computes the cost of each row."""
    text: Callable[[float], str]
    """Formats a cost."""

    def known(self, rows: pd.DataFrame) -> pd.DataFrame:
        """Return the rows that are ok and have a finite positive error and cost."""
        good = (rows["status"] == "ok").to_numpy(bool)
        for values in (self.of(rows).to_numpy(float), rows["rmse_rel"].to_numpy(float)):
            good = good & np.isfinite(values) & (values > 0)
        return rows[good]


def _seconds(value: float) -> str:
    return duration(value).replace("us", "µs").replace(".0 ", " ")


TIME = Cost(lambda rows: rows["time_s"], _seconds)
RATIO = "gradient_cost"
"""Column with the number of rollouts that take as long as one gradient; 1 where it is missing."""
PROGRAM = (
    "scene", "contact", "integrator", "noise", "horizon", "dt", "stiffness", "sigma", "smoothing", "backend", "dtype",
)  # fmt: skip


def with_gradient_cost(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with a column :data:`RATIO`: the measured cost of a gradient in rollouts, per program and backend.

    The ratio is seconds per gradient over seconds per rollout, from the fastest row that uses only gradients and the
    fastest that uses only rollouts, at the largest number of samples with both. Without such rows it is NaN.
    """
    program = rows.groupby([name for name in PROGRAM if name in rows], dropna=False).ngroup()
    known = rows[(rows["status"] == "ok") & (rows["time_s"] > 0)]
    gradients, rollouts = known["gradients"], known["rollouts"]

    def least(seconds: pd.Series) -> pd.Series:
        return seconds.groupby([program, rows["samples"]]).min()

    first = least((known["time_s"] / gradients)[(gradients > 0) & (rollouts <= 0.01 * gradients)])
    zeroth = least((known["time_s"] / rollouts)[(gradients == 0) & (rollouts > 0)])
    ratios = (first / zeroth).dropna().sort_index().groupby(level=0).last()
    return rows.assign(**{RATIO: program.map(ratios).astype(float)})


def _rollouts(rows: pd.DataFrame) -> pd.Series:
    ratio = rows[RATIO].fillna(1.0) if RATIO in rows else 1.0
    return rows["rollouts"] + ratio * rows["gradients"]


ROLLOUTS = Cost(_rollouts, axis_value)
"""Rollouts, with a gradient at its measured cost."""
