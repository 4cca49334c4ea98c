"""Formats the cells of tables as strings, from the quantities that their columns declare."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from bench.experiment.columns import Column
from bench.experiment.views import Table
from bench.report.text import apart, axis_value, duration, number


@dataclass(frozen=True)
class TableCell:
    """One cell of a table as strings, not yet escaped for any format."""

    value: str
    interval: str = ""
    note: str = ""
    bold: bool = False

    def __str__(self) -> str:
        return " ".join(filter(None, (self.value, self.interval, self.note)))


def cell(column: Column, row: Mapping[Any, Any]) -> TableCell:
    """Return the value of a column in a row for readers, with its interval: ``0.50 [0.40, 0.60]``.

    An upper limit is ``< 0.12``. A missing number is ``-``, or the column's note in this row.
    """
    value = row[column.name]
    note = str(row[column.note]) if column.note and isinstance(row[column.note], str) else ""
    bold = bool(column.emphasis and row[column.emphasis] is True)
    if column.kind != "number" or isinstance(value, str):
        return TableCell("" if value is None or value is pd.NA or value != value else str(value), "", note, bold)
    if value is None or math.isnan(value):
        return TableCell(note or "-")
    if column.limit and row[column.limit]:
        return TableCell(f"< {value_text(column, row[column.high] if column.high else value)}", "", note, bold)
    interval = ""
    if column.low and column.high:
        ends = [float(row[name]) for name in (column.low, column.high)]
        if not all(map(math.isnan, ends)):
            interval = "[{}, {}]".format(*(end_text(column, end) for end in ends))
    return TableCell(value_text(column, value), interval, note, bold)


def value_text(column: Column, value: float) -> str:
    """Return a number in the format of a column."""
    if column.format == "seconds":
        return duration(value)
    if column.format == "percent":
        return "-" if math.isnan(value) else f"{number(100 * value, column.digits)}%"
    if column.format == "setting":
        return axis_value(value)
    return number(value, column.digits)


def end_text(column: Column, value: float) -> str:
    """Return an end of an interval in the format of a column, apart from the column's boundary."""
    return value_text(column, value) if column.boundary is None else apart(value, column.boundary, column.digits)


def readable(table: Table) -> pd.DataFrame:
    """Return the table as strings for readers; the headings are the names of the columns."""
    return pd.DataFrame(
        text_rows(table.columns, table.frame, str), columns=[column.heading for column in table.columns]
    )


def text_rows(
    columns: Sequence[Column], frame: pd.DataFrame, format_cell: Callable[[TableCell], str]
) -> list[list[str]]:
    """Return each row's cells, each as ``format_cell`` returns it."""
    used = {name for c in columns for name in (c.name, c.low, c.high, c.limit, c.note, c.emphasis)}
    lines = frame[[name for name in frame if name in used]].to_dict("records")
    return [[format_cell(cell(column, line)) for column in columns] for line in lines]


def parts(table: Table) -> list[tuple[str, pd.DataFrame]]:
    """Return the frames of a table's parts with their headings; one part without a heading where it is not split."""
    if not table.split:
        return [("", table.frame)]
    return [(str(name), part) for name, part in table.frame.groupby(table.split, sort=False)]
