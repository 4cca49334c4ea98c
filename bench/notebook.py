"""Estimates as a notebook shows them: a line of text, and a table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.errors import printable
from bench.model import Problem

if TYPE_CHECKING:
    import pandas as pd

    from bench.measure.statistics import Summary


@dataclass(frozen=True, eq=False)
class Estimates:
    """Independent estimates of a gradient, compared with the reference gradient."""

    problem: Problem
    estimator: str
    """Identity string of the estimator."""
    samples: int
    """N, the number of samples in each estimate."""
    values: np.ndarray
    """The estimates, ``(R, d)``."""
    reference: np.ndarray
    """The reference gradient, ``(d,)``."""
    reference_method: str
    summary: Summary
    """Bias and variance with 95% intervals, see :class:`bench.measure.statistics.Summary`."""
    auxiliaries: Mapping[str, np.ndarray]
    """Diagnostics of the estimator by name, such as a weight, each ``(R,)`` or ``(R, d)``."""

    def _facts(self) -> dict[str, str]:
        """Return the statistics as text, relative to the norm of the reference unless that may be 0."""
        from bench.report.text import number
        from bench.report.views import bias_text, shown_rmse

        row = self.as_dict()
        norm = row["reference_norm"]
        is_relative = math.isfinite(row["rmse_rel"])
        unit = 1.0 if is_relative else norm or 1.0
        _, low, high, is_limit = shown_rmse(row)
        kind = "relative " if is_relative else ""
        interval = f" [{number(low * unit, 3)}, {number(high * unit, 3)}]" if math.isfinite(low + high) else ""
        error = number(row["rmse_rel"] if is_relative else row["rmse"], 3)
        facts = {
            f"{kind}bias": bias_text(row, norm if is_relative else 1.0),
            f"{kind}RMSE": f"< {number(high * unit, 3)}" if is_limit and math.isfinite(high) else f"{error}{interval}",
            "cosine": number(row["cosine"], 3),
            "variance": number(row["variance"], 3),
            "|grad J|": f"{number(norm, 3)} ({self.reference_method})",
            "remark": row["note"],
        }
        return {name: printable(fact) for name, fact in facts.items() if fact}

    def __str__(self) -> str:
        title = f"{self.estimator} on {self.problem.title}: {len(self.values)} estimates of {self.samples} samples"
        return f"{printable(title)}\n" + "; ".join(f"{name} {fact}" for name, fact in self._facts().items())

    __repr__ = __str__

    def as_dict(self) -> dict[str, Any]:
        """Return the statistics by the names of the main table's columns."""
        return asdict(self.summary)

    def to_frame(self) -> pd.DataFrame:
        """Return a row per component of theta: reference, mean of the estimates, its standard error, and their spread.

        ``std`` is the standard deviation of one estimate, and ``se`` that of the mean.
        """
        import pandas as pd

        repeats = len(self.values)
        std = self.values.std(axis=0, ddof=1) if repeats > 1 else np.full(self.reference.size, math.nan)
        columns = {"reference": self.reference, "mean": self.values.mean(axis=0), "se": std / math.sqrt(repeats)}
        names = self.problem.program.decision.names or [f"theta[{index}]" for index in range(self.problem.dim)]
        return pd.DataFrame(columns | {"std": std}, index=pd.Index(names, name="component"))
