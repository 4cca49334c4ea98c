"""Builds the default page, for studies without their own: one chart of any two numbers that the reader chooses."""

from __future__ import annotations

import pandas as pd

from bench.experiment import columns
from bench.experiment.columns import COMMON, IDENTITY
from bench.experiment.experiment import Experiment
from bench.report.text import counted
from bench.report.views import arrange, is_logarithmic
from bench.report.web.content import (
    STATUS,
    Chart,
    Content,
    PlotAxis,
    TableColumn,
    identity_columns,
    looks,
    numeric_axis,
    titled,
)


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the content of the page: counts, a chart of the study's own numbers against swept ones, and the table."""
    shown = arrange(experiment, rows)
    table = shown.rows
    own = [
        column
        for column in experiment.columns.all
        if column.table and column.name not in COMMON and column.name in rows
    ]
    numbers = [column for column in own if column.kind == "number" and table[column.name].notna().any()]
    texts = [column.name for column in own if column.kind == "text" and table[column.name].nunique() > 1]
    named = [name for name in ("scene", "contact", "estimator", "estimator_params") if table[name].nunique() > 1]
    named_rows = table.assign(series=titled(table, named or ["scene"]))
    swept = {axis.column: numeric_axis(axis, axis.column, is_logarithmic(table[axis.column])) for axis in shown.swept()}
    moving = [name for name in IDENTITY if name in table.select_dtypes("number") and table[name].nunique() > 1]
    x = [*swept.values(), *(_axis(table, COMMON[name]) for name in moving if name not in swept)]
    y = [_axis(table, column) for column in numbers]
    good = int((rows["status"] == "ok").sum())
    return Content(
        finding=f"{good} of {counted(len(rows), 'cell')} gave a result.",
        rows=named_rows,
        columns=[
            *identity_columns(table, [axis.column for axis in shown.axes]),
            *(TableColumn(name, name.replace("_", " "), "text") for name in texts),
            *(TableColumn(column.name, column.name.replace("_", " ")) for column in numbers),
            *STATUS,
        ],
        charts=[Chart("Results", "Choose what to see against what.", [*x, *y], y)] if y else [],
        looks=looks(list(named_rows["series"])),
    )


def _axis(rows: pd.DataFrame, column: columns.Column) -> PlotAxis:
    unit = f" [{column.unit}]" if column.unit else ""
    return PlotAxis(column.name, column.name.replace("_", " ") + unit, is_logarithmic(rows[column.name]))
