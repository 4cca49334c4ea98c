"""The views of a study that has none of its own: a table of its numbers and a chart of the first along what was swept."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd

from bench.experiment import axes
from bench.experiment.columns import COMMON, IDENTITY, Column, setting
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Table, Views
from bench.report.problems import titled
from bench.report.views import arrange


def own_columns(experiment: Experiment, rows: pd.DataFrame) -> list[Column]:
    """Return the columns of the study's own table that say something: numbers that are known, and texts that vary."""
    own = [
        c for c in experiment.columns.all if c.table and c.name not in COMMON and c.kind != "list" and c.name in rows
    ]
    return [c for c in own if (rows[c.name].nunique() > 1 if c.kind == "text" else rows[c.name].notna().any())]


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the table of the study's own numbers, and a chart of the first of them."""
    shown = arrange(experiment, rows)
    table = shown.rows
    own = own_columns(experiment, table)
    labels = [COMMON[name] for name in IDENTITY if table[name].nunique(dropna=False) > 1] or [COMMON["scene"]]
    swept = [setting(axis.column, label=axis.title) for axis in shown.swept()]
    labels = [column for column in labels if column.name not in {axis.name for axis in swept}]
    x = [*swept, *(column for column in labels if column.kind == "number")]
    y = [column for column in own if column.kind == "number"]
    names = [column.name for column in labels if column.kind == "text"] or ["scene"]
    frame = table.assign(series=titled(table, names))
    charts = [Chart(experiment.study.name, frame, x[:1], y[:1], "points", series="series")] if x and y else []
    return Views(
        tables=[
            Table(
                experiment.study.name,
                table,
                [*labels, *swept, *(replace(c, digits=3) for c in own), COMMON["status"]],
                data=axes.table(experiment, rows),
                terminal=True,
            )
        ],
        charts=charts,
    )
