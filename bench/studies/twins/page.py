"""The page of the twins: how far engines and scenes are apart, and what an engine's gradient costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from bench.experiment.experiment import Experiment
from bench.report.text import duration, number
from bench.report.web import generic
from bench.report.web.content import Content, nothing_ran


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the largest differences and longest compilation in a sentence, a chart of any two numbers, the table."""
    return replace(generic.content(experiment, rows), finding=nothing_ran(rows) or finding(rows))


def finding(rows: pd.DataFrame) -> str:
    """Write where trajectory and gradient differ most, and the time of compiling and of one batch."""
    good = rows[rows["status"] == "ok"]
    parts = []
    for column, what in (("state_difference", "Trajectories"), ("gradient_difference_rel", "gradients, relatively,")):
        finite = good[np.isfinite(good[column])]
        if len(finite):
            worst = finite.loc[finite[column].idxmax()]
            parts.append(f"{what} differ by {number(worst[column])} at most ({worst['scene']} in {worst['backend']})")
    for backend, part in good.groupby("backend", sort=False):
        times = f"{duration(part['gradient_s'].min())} to {duration(part['gradient_s'].max())}"
        compiled = part["compile_s"].max()
        after = f", after compiling for up to {duration(compiled)}" if compiled > 0 else ""
        counts = " or ".join(f"{count:g}" for count in part["samples"].unique())
        parts.append(f"{backend} takes {times} for {counts} gradients{after}")
    return "; ".join(parts) + "."
