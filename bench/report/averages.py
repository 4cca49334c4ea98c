"""Averages results over swept axes, such as the phase of a step or theta: one line per group of cells and quantity."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis, axes, relabel, with_axes
from bench.experiment.columns import IDENTITY
from bench.experiment.experiment import Experiment
from bench.report.tables import csv, plain_markdown
from bench.report.text import number
from bench.run.files import write_all

SIGNED = "signed error"
"""Norm of the average of (mean estimate - reference), in which errors of opposite sign cancel."""
ROOM = ("bias", "variance", "rmse", "rmse_rel", "model_error", SIGNED)
"""Quantities in the Markdown table, if the study has any of them; the CSV has all quantities."""


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``averages`` (.csv, .md) if the experiment names axes to average over; return the files' paths."""
    table = averages(experiment, rows)
    if table.empty:
        return []
    shown = table[table["quantity"].isin(ROOM)] if table["quantity"].isin(ROOM).any() else table
    texts = shown.drop(columns=["standard_error"]).assign(
        mean=[
            f"{number(m)} +- {number(1.96 * e)}" for m, e in zip(shown["mean"], shown["standard_error"], strict=True)
        ],
        **{name: shown[name].map(number) for name in ("rms", "least", "largest")},
    )
    legend = (
        f"\n\nAverages over {', '.join(experiment.average)}: mean +- 1.96 standard errors (as if the values of the axis had "
        "been drawn at random), root mean square, least and largest.\n"
    )
    return write_all(
        experiment.directory, {"averages.csv": csv(table), "averages.md": plain_markdown(texts.astype(str)) + legend}
    )


def averages(experiment: Experiment, rows: pd.DataFrame) -> pd.DataFrame:
    """Return one row per group of cells and quantity: points, mean, its standard error, RMS, least and largest.

    The cells of a group differ only in the axes of ``experiment.average`` and in the axes that step with them. Rows
    that are not ok are omitted and not counted in ``points``. If rows have mean estimates and reference gradients, the
    quantity ``signed error`` is the norm of the average of their differences.
    """
    wanted = experiment.average
    good = rows[rows["status"] == "ok"]
    if not wanted or good.empty:
        return pd.DataFrame()
    swept = axes(experiment.sweep, good)
    over = [axis for axis in swept if _is_named(axis, wanted)]
    averaged = {axis.column for axis in over} | {column for axis in over for column in axis.moves}
    averaged_axes = [axis for axis in swept if axis.column in averaged]
    wide = relabel(with_axes(experiment, good), averaged_axes).reset_index(drop=True)
    left = [axis.column for axis in swept if axis.column not in averaged]
    keys = [name for name in dict.fromkeys([*IDENTITY, *left]) if name in wide and name not in averaged]
    numbers = [
        column.name
        for column in experiment.columns.all
        if column.kind == "number" and column.table and not column.measured and column.name not in (*IDENTITY, "dim")
    ]
    lines = []
    for key, part in wide.groupby(keys, sort=False, dropna=False):
        shown = dict(zip(keys, key, strict=True))
        lines += [shown | {"quantity": name} | summary(part[name].to_numpy(float)) for name in numbers]
        if {"mean_estimate", "reference_gradient"} <= set(part):
            lines.append(shown | {"quantity": SIGNED} | _signed(part))
    table = pd.DataFrame(lines)
    table = table[table["points"] > 0]
    same = [name for name in keys if name != "estimator" and table[name].nunique(dropna=False) == 1]
    return table.drop(columns=same).reset_index(drop=True)


def _is_named(axis: Axis, wanted: tuple[str, ...]) -> bool:
    """Return whether one of the names is the axis's: its column, a name in the sweep, or ``theta0`` for a coordinate."""
    names = {axis.column, axis.short, axis.column.partition(".")[0], *axis.names}
    return bool(names & set(wanted))


def summary(values: np.ndarray) -> dict[str, float]:
    """Return points, mean, its standard error, RMS, least and largest of the finite values."""
    values = values[np.isfinite(values)]
    n = len(values)
    if not n:
        return {"points": 0}
    return {
        "points": n, "mean": float(values.mean()),
        "standard_error": float(values.std(ddof=1) / math.sqrt(n)) if n > 1 else math.nan,
        "rms": float(np.sqrt(np.mean(values**2))), "least": float(values.min()), "largest": float(values.max()),
    }  # fmt: skip


def _signed(part: pd.DataFrame) -> dict[str, float]:
    """Return the norm of the mean difference and its standard error, and RMS, least and largest norm of the differences."""
    pairs = [
        (np.asarray(mean, float), np.asarray(truth, float))
        for mean, truth in zip(part["mean_estimate"], part["reference_gradient"], strict=True)
    ]
    if len({len(one) for pair in pairs for one in pair}) != 1:
        return {"points": 0}
    apart = np.array([mean - truth for mean, truth in pairs])
    apart = apart[np.isfinite(apart).all(axis=1)]
    lengths = summary(np.linalg.norm(apart, axis=1))
    if not lengths["points"]:
        return lengths
    n = len(apart)
    error = math.sqrt(apart.var(axis=0, ddof=1).sum() / n) if n > 1 else math.nan
    return lengths | {"mean": float(np.linalg.norm(apart.mean(axis=0))), "standard_error": error}
