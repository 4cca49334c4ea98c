"""Formats the cells of tables as strings, from the quantities that their columns declare."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from bench.experiment.columns import Column
from bench.experiment.views import Table
from bench.report.text import axis_value, duration, number

BLOCK = 4096
"""Rows that are turned into dictionaries at a time."""


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
            interval = "[{}, {}]".format(*(value_text(column, end) for end in ends))
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


def readable(table: Table) -> pd.DataFrame:
    """Return the table as strings for readers; the headings are the names of the columns."""
    return pd.DataFrame(
        [[str(cell(column, row)) for column in table.columns] for row in records(table.frame)],
        columns=[column.heading for column in table.columns],
    )


def records(frame: pd.DataFrame) -> Iterator[dict[Any, Any]]:
    """Yield each row as a dictionary, with few rows in memory at a time."""
    for start in range(0, len(frame), BLOCK):
        yield from frame.iloc[start : start + BLOCK].to_dict("records")


def parts(table: Table) -> list[tuple[str, pd.DataFrame]]:
    """Return the frames of a table's parts with their headings; one part without a heading where it is not split."""
    if not table.split:
        return [("", table.frame)]
    return [(str(name), part) for name, part in table.frame.groupby(table.split, sort=False)]
