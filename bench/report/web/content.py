"""The content of a page: a finding, answers, charts and a table, all from the same rows."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment import axes as sweep
from bench.experiment.columns import IDENTITY
from bench.experiment.grid import applies
from bench.model import registry
from bench.report.style import MARKERS, VARIANTS, colour, marker
from bench.report.text import axis_value
from bench.report.views import NUMBERS, Arranged, attempted

SYMBOLS = dict(
    zip(
        MARKERS,
        ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x", "star"),
        strict=True,
    )
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


def logarithmic(values: pd.Series) -> bool:
    """Return whether a logarithmic scale suits some values: all are positive and some far apart."""
    finite_values = values[np.isfinite(values)]
    return bool(len(finite_values) and finite_values.min() > 0 and finite_values.max() > 10 * finite_values.min())


def titled(rows: pd.DataFrame, names: Sequence[str]) -> pd.Series:
    """Return, per row, the values of some text columns, joined by commas; ``none`` and nothing are left out."""
    return pd.Series(
        [", ".join(text for text in map(str, row) if text not in ("", "none")) for row in rows[list(names)].to_numpy()],
        index=rows.index,
        dtype=object,
    )


def nothing_ran(rows: pd.DataFrame) -> str:
    """Return a sentence if there is no result at all; nothing if there is one."""
    tried = attempted(rows)
    if (tried["status"] == "ok").any():
        return ""
    return "No cell gave a result: the table has the reason of each."


def finite(value: float) -> bool:
    """Return whether a value is a finite number."""
    return isinstance(value, int | float) and math.isfinite(value)


# ----------------------------------------------------------------------------------------------------- problems


def grouped(rows: pd.DataFrame, parts: Sequence[str], without: Sequence[sweep.Axis] = ()) -> pd.Series:
    """Number rows so that rows whose ``parts`` have equal parameters, ignoring the axes ``without``, share a number.

    ``parts`` are axes of the grid: ``scene``, ``contact``. Rows of studies with other parameters, or with another
    theta, are never equal. Rows without parameters, as older versions wrote them, are kept apart by their identity
    columns.
    """
    names = [name for axis in without for name in axis.names]
    labels = [name for name in (*parts, *NUMBERS, "noise") if name in rows and name not in {a.column for a in without}]
    texts: dict[int, str] = {}
    groups: dict[Any, int] = {}
    numbers = []
    for given, shown in zip(sweep.parsed(rows), rows[labels].astype(str).to_numpy().tolist(), strict=True):
        if id(given) not in texts:
            kept = {part: _without(part, given.get(part), names) for part in parts}
            texts[id(given)] = json.dumps([kept, given.get("study"), given.get("theta")])
        key = texts[id(given)] if given else tuple(shown)
        numbers.append(groups.setdefault(key, len(groups)))
    return pd.Series(numbers, index=rows.index, dtype=int)


def _without(axis: str, part: Mapping[str, Any] | None, names: Sequence[str]) -> Mapping[str, Any] | None:
    if part is None:
        return None
    hidden = {applies(name, registry.kind_of(axis), part["name"], part) for name in names}
    return {name: value for name, value in part.items() if name == "name" or name not in hidden}


def together(shown: Arranged, *columns: str) -> list[sweep.Axis]:
    """Return the axes that hold the values of some columns, also under other names, and axes that step with them."""
    own = [
        axis for axis in shown.axes if axis.column in columns or (axis.short in columns and _holds(shown.rows, axis))
    ]
    moving = {name for axis in own for name in axis.moves}
    return [axis for axis in shown.axes if axis in own or axis.column in moving]


def _holds(rows: pd.DataFrame, axis: sweep.Axis) -> bool:
    """Return whether the values of an axis are those of the column of its parameter's name."""
    own = rows[axis.column].notna()
    return bool((rows.loc[own, axis.short] == rows.loc[own, axis.column]).all())


def constants(rows: pd.DataFrame, groups: pd.Series, names: Sequence[str]) -> pd.DataFrame:
    """Return a line per group, in order of appearance: the values of columns, nothing where its rows differ."""
    one = rows[list(names)].groupby(groups, sort=False)
    values = one.first().reindex(groups.unique()).astype(object)
    return values.mask(one.nunique(dropna=False).reindex(values.index) > 1, "")


def distinguishing_columns(
    rows: pd.DataFrame, groups: pd.Series, names: Sequence[str], always: Sequence[str] = ("scene",)
) -> list[str]:
    """Choose, of some columns, those that distinguish the groups, each only where the ones before it do not suffice."""
    names = [name for name in names if name in rows]
    values = constants(rows, groups, names)

    def count(columns: Sequence[str]) -> int:
        return len({tuple(map(str, line)) for line in values[list(columns)].to_numpy()})

    choice: list[str] = []
    for name in names:
        if name in always or count([*choice, name]) > count(choice):
            choice.append(name)
    return choice


def problems(
    shown: Arranged,
    parts: Sequence[str],
    without: Sequence[sweep.Axis] = (),
    always: Sequence[str] = ("scene",),
    rows: pd.DataFrame | None = None,
) -> pd.Series:
    """Name the problem of each row, ``mass_spring, damping=0``: no two that differ in ``parts`` have the same name.

    ``always`` are columns to name even where they distinguish nothing. ``rows`` are those of ``shown``, or some of
    them.
    """
    rows = shown.rows if rows is None else rows
    groups = grouped(rows, parts, without)
    columns = distinguishing_columns(rows, groups, columns_of(shown, parts, without), always)
    names: dict[Any, str] = {}
    for group, line in constants(rows, groups, columns).iterrows():
        name = ", ".join(filter(None, (_named(column, value) for column, value in line.items())))
        names[group] = name if name not in names.values() else f"{name} ({group})"
    return groups.map(names).astype(object)


def columns_of(shown: Arranged, parts: Sequence[str], without: Sequence[sweep.Axis] = ()) -> list[str]:
    """Return the columns that show some parts of the grid: identity strings, then numbers, less those of some axes."""
    more = {"backend": ["dtype"], "estimator": ["estimator_params"], "scene": ["noise"]}
    labels = [*parts, *(name for part in parts for name in more.get(part, []))]
    return [name for name in (*labels, *shown.numbers) if name not in {axis.column for axis in without}]


def shown_as(value: Any) -> str:
    """Write a value of such a column as text."""
    return value if isinstance(value, str) else axis_value(value)


def _named(column: Any, value: Any) -> str:
    if isinstance(value, str):
        return "" if value == "none" else value
    return f"{column}={axis_value(value)}" if math.isfinite(value) else ""
