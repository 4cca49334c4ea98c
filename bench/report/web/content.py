"""The content of a page: a finding, answers, charts and a table, all from the same rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from bench.experiment import axes as sweep
from bench.experiment.columns import IDENTITY
from bench.report.problems import (
    distinguishing_columns,
)
from bench.report.style import MARKERS, VARIANTS, colour, marker
from bench.report.views import attempted

__all__ = ["distinguishing_columns"]
SYMBOLS = dict(
    zip(MARKERS, ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x", "star"), strict=True)
)
"""Plotly's names of the charts' markers."""
DASHES = dict(zip(map(str, VARIANTS), ("solid", "dash", "dot"), strict=True))
"""Plotly's names of the charts' line styles."""
DARK = {"#000000": "#ffffff"}
"""Colours that a dark page needs instead; the others stand out on both backgrounds."""


@dataclass(frozen=True)
class PlotAxis:
    """A column that can be an axis: its label, its scale, and the columns of its interval.

    Where the column ``limit`` is not 0 the value is an upper limit.
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
    """A chart of a table: points, joined to lines where ``line`` names a column, one panel per value of ``facet``.

    A chart with ``level`` is a map of that column instead; with ``share`` as well, of the share of that level among the
    rows at each place. With ``front`` the points that no other of the same ``front`` beats in x and y are marked.
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
    marks: dict[str, float] = field(default_factory=dict)
    """Named values of x."""


@dataclass(frozen=True)
class TableColumn:
    """A column of the main table; ``kind``: text, number, seconds (``!`` if ``flag`` is not 0), limit (``<`` then)."""

    name: str
    label: str
    kind: str = "number"
    flag: str = ""


@dataclass(frozen=True)
class Content:
    """Everything that a page shows of a study."""

    finding: str
    rows: pd.DataFrame
    columns: list[TableColumn]
    charts: list[Chart]
    answers: pd.DataFrame = field(default_factory=pd.DataFrame)
    """Texts: what to use where."""
    answers_title: str = "What to use where"
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    """Further tables for charts; their column ``row`` is the row of ``rows`` that a line comes from."""
    looks: dict[str, dict[str, Any]] = field(default_factory=dict)
    """For each value of a chart's ``series`` or ``level``: colour, symbol, dash, letter, meaning."""
    swept: Sequence[str] = ()
    """Columns of ``rows`` that hold swept parameters besides the common ones; filled in when the page is written."""


def look(
    colour: str, symbol: str = "circle", dash: str = "solid", letter: str = "", meaning: str = ""
) -> dict[str, Any]:
    """Return how one series is drawn: its colour on light and on dark background, and its other marks."""
    style = {"colour": [colour, DARK.get(colour, colour)], "symbol": symbol, "dash": dash}
    return style | {name: text for name, text in (("letter", letter), ("meaning", meaning)) if text}


def looks(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return a colour of its own for each name (the palette's, then darker and lighter ones) and a symbol."""
    return {name: look(colour(i), SYMBOLS[marker(i)]) for i, name in enumerate(dict.fromkeys(names))}


def identity_columns(rows: pd.DataFrame, swept: Sequence[str] = ()) -> list[TableColumn]:
    """Return the identity columns and the swept ones that vary; those whose values are numbers are shown as such."""
    names = [name for name in dict.fromkeys((*IDENTITY, *swept)) if name in rows]
    varying = [name for name in names if rows[name].nunique(dropna=False) > 1] or ["scene", "estimator"]
    texts = {name for name in varying if not pd.api.types.is_numeric_dtype(rows[name])}
    return [TableColumn(name, name.replace("_", " "), "text" if name in texts else "number") for name in varying]


STATUS = [TableColumn("status", "status", "text"), TableColumn("reason", "reason", "text")]
"""The last columns of every main table."""


def numeric_axis(axis: sweep.Axis, column: str = "x", log: bool = True) -> PlotAxis:
    """Return a swept parameter as an axis of a chart, named with its unit and what moves with it."""
    return PlotAxis(column, axis.title, log)


def titled(rows: pd.DataFrame, names: Sequence[str]) -> pd.Series:
    """Return, per row, the values of some text columns joined by commas, without ``none`` and empty ones."""
    return pd.Series(
        [", ".join(text for text in map(str, row) if text not in ("", "none")) for row in rows[list(names)].to_numpy()],
        index=rows.index,
        dtype=object,
    )


def no_result_sentence(rows: pd.DataFrame) -> str:
    """Return a sentence that no cell has a result; empty if one has."""
    has_result = bool((attempted(rows)["status"] == "ok").any())
    return "" if has_result else "No cell gave a result: the table has the reason of each."


def finite(value: float) -> bool:
    """Return whether a value is a finite number."""
    return isinstance(value, int | float) and math.isfinite(value)
