"""What tables and charts of several studies share: names of problems and methods, the table of cells, limits, long frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from bench.experiment import axes
from bench.experiment.columns import COMMON, Column, setting
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import PROBLEM
from bench.experiment.views import Table
from bench.report.problems import axes_of, label_columns, problem_names
from bench.report.views import arrange, attempted


class Shown:
    """The attempted rows of an experiment with the columns ``problem``, ``method`` and ``row``, the place of the cell.

    Problems do not differ in the columns ``along``, such as the horizon. ``problem`` and ``method`` are parts of the grid.
    """

    def __init__(
        self,
        experiment: Experiment,
        rows: pd.DataFrame,
        along: Sequence[str] = (),
        method: Sequence[str] = ("backend",),
        problem: Sequence[str] = PROBLEM,
    ) -> None:
        self.experiment, self.stored = experiment, rows
        self.arranged = arrange(experiment, rows)
        self.over = axes_of(self.arranged, *along)
        self.parts = tuple(dict.fromkeys((*problem, *method)))
        tried = attempted(self.arranged.rows)
        self.rows = tried.assign(
            problem=problem_names(self.arranged, problem, self.over, rows=tried),
            method=problem_names(self.arranged, method, self.arranged.axes, method, rows=tried),
            row=tried.index,
        )

    @property
    def good(self) -> pd.DataFrame:
        """The rows of cells that gave a result."""
        return self.rows[self.rows["status"] == "ok"]

    def column(self, name: str, **more: Any) -> Column:
        """Return a column of the study, with other attributes."""
        return replace(self.experiment.columns.by_name[name], **more)

    def cells(
        self,
        columns: Sequence[Column | str],
        title: str,
        notes: Sequence[str],
        always: Sequence[str] = ("scene", "contact", "backend"),
        rows: pd.DataFrame | None = None,
        terminal: bool = True,
    ) -> Table:
        """Return the table with a line per cell that was run: what identifies it, some columns or their names, and its status."""
        rows = self.rows if rows is None else rows
        shown = [self.column(one, digits=3) if isinstance(one, str) else one for one in columns]
        labels = label_columns(self.arranged, self.parts, self.over, always=always, rows=rows)
        heads = [COMMON.get(name, setting(name)) for name in labels]
        return Table(
            self.experiment.study.name,
            rows,
            [*heads, *shown, COMMON["status"]],
            title,
            notes,
            terminal=terminal,
            data=axes.table(self.experiment, self.stored),
        )


def stacked(frame: pd.DataFrame, series: Mapping[str, str], value: str) -> pd.DataFrame:
    """Return one copy of a frame per series, whose column and ends of intervals become ``value``: a column per name."""
    parts = []
    for name, column in series.items():
        ends = {f"{value}{end}": frame[f"{column}{end}"] for end in ("", "_low", "_high") if f"{column}{end}" in frame}
        parts.append(frame.assign(series=name, **ends))
    return pd.concat(parts, ignore_index=True)
