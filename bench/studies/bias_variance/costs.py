"""The cost of an estimate: seconds on this machine, or rollouts on any machine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from bench.report.text import axis_value, duration


@dataclass(frozen=True)
class Cost:
    """A way to count what one estimate costs."""

    name: str
    """The cost as it ends ``Relative RMSE of one estimate against``."""
    label: str
    """The label of an axis."""
    of: Callable[[pd.DataFrame], pd.Series]
    """The cost of each row."""
    spread: Callable[[pd.DataFrame], pd.Series]
    """Half its interquartile range."""
    text: Callable[[float], str]
    """The cost as printed."""

    def known(self, rows: pd.DataFrame) -> pd.DataFrame:
        """Return the rows that have both an error and a cost."""
        cost = self.of(rows)
        good = (rows["status"] == "ok") & np.isfinite(rows["rmse_rel"]) & np.isfinite(cost)
        return rows[good & (rows["rmse_rel"] > 0) & (cost > 0)]


def _seconds(value: float) -> str:
    return duration(value).replace("us", "µs").replace(".0 ", " ")


def _half_range(rows: pd.DataFrame) -> pd.Series:
    return rows["time_iqr_s"].fillna(0.0) / 2


TIME = Cost("the time it takes", "time of one estimate", lambda rows: rows["time_s"], _half_range, _seconds)
TIME_COMPILED = Cost(
    "the time it takes, compilation included",
    "time with compilation",
    lambda rows: rows["time_s"] + rows["compile_s"].fillna(0.0),
    _half_range,
    _seconds,
)
ROLLOUTS = Cost(
    "its rollouts",
    "rollouts, a gradient counting as one",
    lambda rows: rows["rollouts"] + rows["gradients"],
    lambda rows: 0.0 * rows["rollouts"],
    axis_value,
)
