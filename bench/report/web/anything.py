"""The page of a study that has none of its own: one chart of whichever two of its numbers the reader picks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from bench.grid import Experiment
from bench.report.web.content import STATUS, Axis, Chart, Column, Content, counted, identity_columns, looks, titled
from bench.store import IDENTITY, TEXT


def content(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> Content:
    """Counts, a chart of the study's own numbers against the swept ones, and the table."""
    own = [name for name in rows if name not in (*IDENTITY, *TEXT, "dim")]
    numbers = [str(name) for name in own if pd.api.types.is_numeric_dtype(rows[name]) and rows[name].notna().any()]
    texts = [str(name) for name in own if name not in numbers and rows[name].map(type).eq(str).all()]
    made = rows.assign(series=titled(rows, ["scene", "estimator", "estimator_params"]))
    swept = [name for name in IDENTITY if name in rows.select_dtypes("number") and rows[name].nunique() > 1]
    x = [_axis(rows, name) for name in (*swept, *numbers)]
    y = [_axis(rows, name) for name in numbers]
    good = int((rows["status"] == "ok").sum())
    return Content(
        finding=f"{good} of {counted(len(rows), 'cell')} gave a result.",
        rows=made,
        columns=[
            *identity_columns(rows),
            *(Column(name, name.replace("_", " "), "text") for name in texts if rows[name].nunique() > 1),
            *(Column(name, name.replace("_", " ")) for name in numbers),
            *STATUS,
        ],
        charts=[Chart("Results", "Choose what to see against what.", x, y)] if x and y else [],
        looks=looks(list(made["series"])),
    )


def _axis(rows: pd.DataFrame, name: str) -> Axis:
    """Logarithmic where all values are positive and some are apart."""
    values = rows[name][np.isfinite(rows[name])]
    return Axis(
        name, name.replace("_", " "), log=bool(len(values) and values.min() > 0 and values.max() > 10 * values.min())
    )
