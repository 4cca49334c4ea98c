"""The classes that describe a page's content (finding, answers, charts, table), and functions that build their parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from bench.experiment.columns import IDENTITY
from bench.report.problems import distinguishing_columns, titled
from bench.report.style import MARKERS, colour, marker

__all__ = ["distinguishing_columns", "titled"]
SYMBOLS = dict(
    zip(MARKERS, ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x", "star"), strict=True)
)
"""Plotly's name of each Matplotlib marker."""
DARK = {"#000000": "#ffffff"}
"""Replacements for colours on a dark page; all other colours are visible on both backgrounds."""


@dataclass(frozen=True)
class PlotAxis:
    """A column to use as an axis: its label, its scale, and the columns ``low`` and ``high`` of its interval.

    Where the column ``limit`` is not 0, the value is an upper limit.
    """

    column: str
    label: str
    log: bool = True
    low: str = ""
    high: str = ""
    limit: str = ""
    above_one: str = ""
    """The meaning of a value above 1; the background there is shaded."""


@dataclass(frozen=True)
class Chart:
    """A chart of a table: points, one panel per value of the column ``facet``, joined to lines by the column ``line``.

    A chart with ``level`` is a map of that column instead. With ``share`` too, the map shows which share of the rows at
    each position has that level. With ``front``, points are marked that no other point with the same value of that
    column beats in both x and y.
    """

    title: str
    text: str
    x: Sequence[PlotAxis]
    y: Sequence[PlotAxis]
    table: str = "rows"
    series: str = "series"
    facet: str = ""
    line: str = ""
    front: str = ""
    level: str = ""
    share: str = ""
    fill: str = ""
    """The column with the colour of each cell of a map, ``#rrggbb``, instead of ``level``."""
    cell: str = ""
    """The column with the text in each cell of a map; by default the level's letter."""
    join: bool = False
    """Whether the points with the same value of a text axis y are joined."""
    marks: dict[str, float | list[float | None]] = field(default_factory=dict)
    """Named values of x, and named ranges ``[from, to]``, where None is the end of the axis."""
    y_marks: dict[str, float | list[float | None]] = field(default_factory=dict)


@dataclass(frozen=True)
class TableColumn:
    """A column of the main table. ``kind`` is text, number, seconds or limit.

    Where the column ``flag`` is not 0, seconds are marked with ``!`` and limits with ``<``.
    """

    name: str
    label: str
    kind: str = "number"
    flag: str = ""


@dataclass(frozen=True)
class Content:
    """The content of a page: finding, table, charts, answers, and the data behind them."""

    finding: str
    rows: pd.DataFrame
    columns: list[TableColumn]
    charts: list[Chart]
    answers: pd.DataFrame = field(default_factory=pd.DataFrame)
    """A table of strings, such as the recommended estimators."""
    answers_title: str = "What to use where"
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    """Further tables for charts, by name. Their column ``row`` is the position in ``rows`` that a line belongs to."""
    looks: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Colour, symbol, dash, letter and meaning of each value of a chart's ``series`` or ``level``: see :func:`look`."""
    swept: Sequence[str] = ()
    """Columns of ``rows`` with the swept parameters; set when the page is written."""


def look(
    colour: str, symbol: str = "circle", dash: str = "solid", letter: str = "", meaning: str = ""
) -> dict[str, Any]:
    """Return the style of one series: its colours on a light and a dark background, symbol, dash, letter and meaning."""
    style = {"colour": [colour, DARK.get(colour, colour)], "symbol": symbol, "dash": dash}
    return style | {name: text for name, text in (("letter", letter), ("meaning", meaning)) if text}


def looks(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return a style for each name, with a distinct colour (the palette, then darker and lighter hues) and a symbol."""
    return {name: look(colour(i), SYMBOLS[marker(i)]) for i, name in enumerate(dict.fromkeys(names))}


def identity_columns(rows: pd.DataFrame, swept: Sequence[str] = ()) -> list[TableColumn]:
    """Return the identity and swept columns that vary, as columns of kind number or text."""
    names = [name for name in dict.fromkeys((*IDENTITY, *swept)) if name in rows]
    varying = [name for name in names if rows[name].nunique(dropna=False) > 1] or ["scene", "estimator"]
    texts = {name for name in varying if not pd.api.types.is_numeric_dtype(rows[name])}
    return [TableColumn(name, name.replace("_", " "), "text" if name in texts else "number") for name in varying]


STATUS = [TableColumn("status", "status", "text"), TableColumn("reason", "reason", "text")]
"""The last columns of every main table."""
