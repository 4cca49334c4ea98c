"""Tables that several studies share, and the views of a study that has none of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pandas as pd

from bench.experiment import axes
from bench.experiment.columns import COMMON, IDENTITY, Column
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Table, Views
from bench.report.problems import label_columns, titled
from bench.report.text import counted
from bench.report.views import Arranged, arrange, attempted

ENGINE = ("scene", "contact", "integrator", "backend")
"""Parts of the grid that identify a line of a table of engines."""


def engine_table(
    experiment: Experiment,
    rows: pd.DataFrame,
    shown: Arranged,
    numbers: Sequence[Column],
    title: str,
    notes: Sequence[str],
    always: Sequence[str] = ("scene", "contact", "backend"),
) -> Table:
    """Return the table of the cells that were run, a line per scene and engine with some ``numbers``."""
    tried = attempted(shown.rows)
    labels = label_columns(shown, ENGINE, always=always, rows=tried)
    columns = [*(COMMON.get(name, Column(name)) for name in labels), *numbers, COMMON["status"]]
    return Table(experiment.study.name, tried, columns, title, notes, terminal=True, data=axes.table(experiment, rows))


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return how many cells have results, the table of the study's own numbers, and their chart on the page."""
    shown = arrange(experiment, rows)
    table = shown.rows
    own = [
        c for c in experiment.columns.all if c.table and c.name not in COMMON and c.kind != "list" and c.name in rows
    ]
    own = [c for c in own if (table[c.name].notna().any() if c.kind == "number" else table[c.name].nunique() > 1)]
    labels = [COMMON[name] for name in IDENTITY if table[name].nunique(dropna=False) > 1] or [COMMON["scene"]]
    swept = [Column(axis.column, label=axis.title, format="setting") for axis in shown.swept()]
    labels = [column for column in labels if column.name not in {axis.name for axis in swept}]
    y = [column for column in own if column.kind == "number"]
    x = [*swept, *(column for column in labels if column.kind == "number"), *y]
    names = [column.name for column in labels if column.kind == "text"] or ["scene"]
    frame = table.assign(series=titled(table, names), row=range(len(table)))
    charts = [
        Chart(experiment.study.name, "Results", frame, x, y, "points", series="series", printed=False,
              text="Choose the quantities of both axes.")
    ] if y else []  # fmt: skip
    good = int((rows["status"] == "ok").sum())
    return Views(
        findings=[f"{good} of {counted(len(rows), 'cell')} gave a result."],
        tables=[
            Table(experiment.study.name, table, [*labels, *swept, *(replace(c, digits=3) for c in own), COMMON["status"]],
                  data=axes.table(experiment, rows), terminal=True)
        ],
        charts=charts,
    )  # fmt: skip
