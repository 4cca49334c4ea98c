"""The page of the twins: how far engines and scenes are apart, and what an engine's gradient costs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pandas as pd

from bench.grid import Experiment
from bench.report.views import duration, number
from bench.report.web import anything
from bench.report.web.content import Content, nothing_ran


def content(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> Content:
    """The largest differences and the dearest compilation in one sentence, one chart of any two numbers, the table."""
    shown = rows.drop(columns=["path", "own_path"], errors="ignore")
    return replace(anything.content(experiment, shown, axes), finding=nothing_ran(rows) or finding(rows))


def finding(rows: pd.DataFrame) -> str:
    """Where trajectory and gradient differ most, and what compiling and one batch cost."""
    good = rows[rows["status"] == "ok"]
    parts = []
    for column, what in (("state_difference", "Trajectories"), ("gradient_difference_rel", "gradients, relatively,")):
        worst = good.loc[good[column].idxmax()]
        parts.append(f"{what} differ by {number(worst[column])} at most ({worst['scene']} in {worst['backend']})")
    for backend, part in good.groupby("backend", sort=False):
        times = f"{duration(part['gradient_s'].min())} to {duration(part['gradient_s'].max())}"
        compiled = part["compile_s"].max()
        after = f", after compiling for up to {duration(compiled)}" if compiled > 0 else ""
        parts.append(f"{backend} takes {times} for {part['samples'].iloc[0]:g} gradients{after}")
    return "; ".join(parts) + "."
