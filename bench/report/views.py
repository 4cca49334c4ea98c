"""Arranges rows for reading, for tables, charts and pages.

:func:`arrange` adds a column per swept axis. :func:`rows_along` selects the rows along one axis, and
:mod:`bench.report.problems` splits them by problem. :func:`estimator_curves` returns one curve per estimator of a
problem, with agreeing backends merged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis, axes, relabel, smoothing_of, values_of
from bench.experiment.columns import FIRST, IDENTITY
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import completed_rows, named
from bench.measure.timing import NOISY
from bench.report.text import number

CATEGORIES = ("scene", "contact", "integrator", "noise")
NUMBERS = tuple(column.name for column in FIRST if column.kind == "number" and column.name != "seed")
"""Numeric identity columns; with the categories and the swept axes they identify the problem of a row."""
CELL = ("study", "parameters", "samples", "repeats", "seed")
"""The columns that identify a cell."""
CLOSE = 1e-2
"""Largest relative difference between backends whose numbers count as equal."""


def attempted(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of cells that were run, without refused cells."""
    return rows[~rows["status"].isin(("unsupported", "unavailable", "waiting"))]


def newest_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Return each cell's newest row, its parameters completed with today's defaults: rows of older versions stay stored."""
    return completed_rows(rows).drop_duplicates(list(CELL), keep="last", ignore_index=True)


@dataclass(frozen=True, eq=False)
class Arranged:
    """An experiment's rows with a column per swept axis, and labels that omit the swept parameters."""

    experiment: Experiment
    rows: pd.DataFrame
    axes: tuple[Axis, ...]

    @property
    def numbers(self) -> list[str]:
        """Return the numeric columns that identify the problem of a row."""
        return [*NUMBERS, *(a.column for a in self.axes if a.column not in (*NUMBERS, "seed"))]

    def swept(self) -> dict[Axis, int]:
        """Return the axes with two or more values, and the number of values. Seeds are merged and never an axis."""
        counts = {a: int(rows_along(self, a)["x"].nunique()) for a in self.axes if a.column != "seed"}
        return {axis: count for axis, count in counts.items() if count > 1}

    def marks(self, axis: Axis) -> Mapping[str, float]:
        """Return the experiment's named values to draw on an axis."""
        names = (axis.column, *axis.names, axis.short)
        return next((self.experiment.marks[name] for name in names if name in self.experiment.marks), {})


def arrange(experiment: Experiment, rows: pd.DataFrame) -> Arranged:
    """Return an experiment's rows arranged for reading: with a column per swept axis, and shorter labels."""
    swept_axes = axes(experiment.whole_sweep, rows)
    table = relabel(rows, swept_axes)
    for axis in swept_axes:
        if axis.column not in rows:
            table = table.assign(**{axis.column: values_of(axis, rows)})
            # `stiffness` and `smoothing` repeat a parameter of the law, which is swept under its own name here
            for (part, law, name), values in named(rows, axis.names).items():
                view = "smoothing" if name == smoothing_of(law) else name
                if part == "contact" and view in NUMBERS:
                    table[view] = table[view].mask(values.notna())
    return Arranged(experiment, table, tuple(swept_axes))


def rows_along(shown: Arranged, axis: Axis | None) -> pd.DataFrame:
    """Return the rows that have a value of an axis, with seeds merged.

    The axis's values move to a new column ``x``; without an axis, ``x`` is 0.
    """
    table = merge_seeds(shown.rows).copy()  # one block of memory: slicing a fragmented table is slow
    if axis is None:
        return table.assign(x=0.0)
    table = table.assign(x=table[axis.column], **{axis.column: math.nan})
    return table[np.isfinite(table["x"])]


def merge_seeds(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one row per cell, with medians over the seeds that are ok."""
    good = rows["status"] == "ok"
    if rows["seed"].nunique() < 2:
        return rows
    identity = [c for c in dict.fromkeys((*CELL, *IDENTITY)) if c != "seed"]
    cell = rows.groupby(identity, dropna=False, sort=False).ngroup()
    merged = rows.assign(cell=cell, bad=~good).sort_values("bad", kind="stable").drop_duplicates("cell")
    merged = merged.set_index("cell").sort_index().drop(columns="bad")
    medians = rows[good].groupby(cell[good])[list(rows.select_dtypes("number").columns)].median()
    merged.loc[medians.index, medians.columns] = medians
    return merged.reset_index(drop=True)


def estimator_labels(rows: pd.DataFrame) -> pd.Series:
    """Return the estimator's identity string of each row: its name, then its non-default parameters in brackets."""
    names, params = rows["estimator"], rows["estimator_params"]
    return names.where(params == "", names + "[" + params + "]")


RUN = ("estimator", "estimator_params", "backend", "dtype")
"""Columns that distinguish the runs of one problem along an axis."""


def estimator_curves(rows: pd.DataFrame, close: float | None = CLOSE) -> pd.DataFrame:
    """Return one problem's rows as curves along ``x``, one per estimator, in order of appearance; refused cells are omitted.

    Backends within a relative difference of ``close`` are merged into one curve, which has the rows of the first. With None,
    each backend has its own curve. New columns number the curve, and give its estimator's identity string ``label``, its
    ``backends``, the median time [s] of one estimate on the fastest of them (NaN if none is timed), and its name ``method``:
    the label, with the backends where an estimator has several curves.
    """
    rows = attempted(rows).reset_index(drop=True)
    dtype = " " + rows["dtype"] if rows["dtype"].nunique() > 1 else ""
    rows = rows.assign(label=estimator_labels(rows), run=rows["backend"] + dtype)
    last = rows[["label", "run", "x"]].drop_duplicates(keep="last").sort_values("x", kind="stable")
    places = last.groupby(["label", "run"]).groups
    met, seconds = rows[["x", "status"]].to_numpy(object), rows["time_s"]
    numbers = rows[["rmse", "variance", "bias_high", "bias"]].to_numpy(float)

    def agree(a: Any, b: Any) -> bool:
        """Return whether two runs have the same status at every ``x``, and numbers within the relative difference."""
        if close is None or not np.array_equal(met[a], met[b]):
            return a is b
        x, y = numbers[a], numbers[b]
        with np.errstate(invalid="ignore"):
            margin = close * np.fmax(*np.abs([x, y]))[:, [0, 1, 2, 2]]
            return bool(((x == y) | (np.isnan(x) & np.isnan(y)) | (np.abs(x - y) <= margin)).all())

    curves: list[tuple[Any, ...]] = []
    for label, names in rows.groupby("label", sort=False)["run"].unique().items():
        runs = {name: places[label, name].to_numpy() for name in names}
        while runs:
            first = next(iter(runs.values()))
            alike = [name for name, run in runs.items() if agree(first, run)]
            times = pd.Series([seconds[runs.pop(name)].median() for name in alike])
            fastest = times[times > 0].min()
            curves += [(place, len(curves), ", ".join(alike), fastest) for place in first]
    found = pd.DataFrame(curves, columns=["place", "curve", "backends", "seconds"])
    frame = rows.loc[found.pop("place")].reset_index(drop=True).assign(**found)
    is_only = frame.groupby("label")["curve"].transform("nunique") == 1
    return frame.assign(method=frame["label"].where(is_only, frame["label"] + " (" + frame["backends"] + ")"))


def is_logarithmic(values: Any) -> bool:
    """Return whether an axis is logarithmic: finite values are positive, and the largest is at least 8 times the least."""
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    return bool(finite.size and finite.min() > 0 and finite.max() >= 8 * finite.min())


def pareto(time: pd.Series, error: pd.Series) -> np.ndarray:
    """Return a mask of the points on the Pareto front: no other point is smaller in both time and error.

    The zero estimate takes no time and has an error of 1, so no point of a larger error is on the front.
    """
    points = pd.DataFrame({"time": time.to_numpy(), "error": error.to_numpy()})
    best = points.groupby("time")["error"].min().cummin().shift(fill_value=math.inf)
    return np.asarray(points["error"] <= points["time"].map(best).clip(upper=1.0))


def unsteady(rows: Any) -> Any:
    """Return whether a timing's interquartile range is over 20% of its median: of one row, or of each row of a table."""
    return rows["time_iqr_s"] > NOISY * rows["time_s"]


def rmse_interval(row: Any) -> tuple[Any, Any]:
    """Return the 95% interval of the relative RMSE of one row or each row of a table; NaN if the variance has none.

    RMSE^2 = bias^2 + variance, so each end combines the corresponding ends of bias and variance.
    """
    norm = np.where(row["reference_norm"] > 0, row["reference_norm"], math.nan)
    low, high = (
        np.hypot(row[f"bias_{end}"], np.sqrt(row.get(f"variance_{end}", math.nan))) / norm for end in ("low", "high")
    )
    return low, high


def shown_rmse(row: Any) -> tuple[Any, Any, Any, Any]:
    """Return the relative RMSE of one row or each row of a table, its interval, and whether the value is an upper limit.

    The value is the upper end of the interval where the bias is not distinguishable from 0 and the reference's error is at
    least the standard deviation of one estimate, so that the reference's error decides the bias; NaN if that end is above 1,
    the error of the zero estimate, since it then says nothing.
    """
    low, high = rmse_interval(row)
    is_limit = np.logical_not(row["bias_low"] > 0) & (row["reference_se"] >= np.sqrt(row["variance"]))
    value = np.where(is_limit, np.where(high <= 1.0, high, math.nan), row["rmse_rel"])
    return np.where(np.isnan(row["rmse_rel"]), math.nan, value), low, high, is_limit


def bias_text(row: Any, norm: float) -> str:
    """Format a bias divided by a norm: ``0.500 [0.400, 0.600]``, or ``0 (< 0.124)`` if not distinguishable from 0."""
    value, low, high = (row[c] / norm if norm > 0 else math.nan for c in ("bias", "bias_low", "bias_high"))
    if not low > 0 and math.isfinite(high):
        return f"0 (< {number(high, 3)})" if high > 0 else "0"
    text = number(value, 3)
    return f"{text} [{number(low, 3)}, {number(high, 3)}]" if math.isfinite(low + high) else text
