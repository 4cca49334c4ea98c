"""Builds the page of the twins: differences between engines and own programs, and the time of an engine's gradient."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from bench.experiment.experiment import Experiment
from bench.report.text import duration, number
from bench.report.web import generic
from bench.report.web.content import Content, no_result_sentence


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the content of the page: the finding, a chart of any two numbers, and the table."""
    return replace(generic.content(experiment, rows), finding=no_result_sentence(rows) or finding(rows))


def finding(rows: pd.DataFrame) -> str:
    """Format the largest differences of states and gradients, and the times of one batch and of compilation."""
    good = rows[rows["status"] == "ok"]
    parts = []
    for column, quantity in (("state_difference", "states"), ("gradient_difference_rel", "gradients (relative)")):
        finite = good[np.isfinite(good[column])]
        if len(finite):
            worst = finite.loc[finite[column].idxmax()]
            where = f"{worst['scene']} in {worst['backend']}"
            parts.append(f"Largest difference of {quantity}: {number(worst[column])} ({where})")
    for backend, part in good.groupby("backend", sort=False):
        times = f"{duration(part['gradient_s'].min())} to {duration(part['gradient_s'].max())}"
        compiled = part["compile_s"].max()
        compilation = f", after at most {duration(compiled)} of compilation" if compiled > 0 else ""
        counts = " or ".join(f"{count:g}" for count in part["samples"].unique())
        parts.append(f"{backend} computes {counts} gradients in {times}{compilation}")
    return ". ".join(parts) + "."
