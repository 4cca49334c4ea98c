"""Returns what a page shows as data for its script: cells and tables by column, charts, filters, and commands."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

import pandas as pd

from bench.experiment.columns import COMMON, IDENTITY, Column
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Views
from bench.report import draw, reproduce
from bench.report.problems import varying_identity
from bench.report.style import MARKERS, VARIANTS
from bench.report.views import arrange, is_logarithmic, unsteady

SYMBOLS = dict(
    zip(MARKERS, ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x", "star"), strict=True)
)
"""Plotly's name of each Matplotlib marker."""
DASHES = dict(zip(map(str, (*VARIANTS, "none")), ("solid", "dash", "dot", "none"), strict=True))
"""Plotly's name of each Matplotlib line style."""
DARK = {"#000000": "#ffffff"}
"""Replacements for colours on a dark page; all other colours are visible on both backgrounds."""
DIGITS = 6
"""Significant digits of the numbers in a page."""
FORMAT = f".{DIGITS}g"
MOST = 24
"""Largest number of distinct values of a column that is offered as a filter."""
IN_SIGHT, FIRST = 5, 3
"""Most identity and result columns before the status, which a laptop then shows without scrolling."""


def page_data(
    experiment: Experiment, rows: pd.DataFrame, views: Views, commands: Sequence[Sequence[str]]
) -> dict[str, Any]:
    """Return the data of an experiment's page. ``commands`` are the words that run each row's cell.

    The table ``rows`` has a line per cell, with a column for every swept parameter. Each chart has a table of its own;
    columns that it lacks come from the cells. The columns of tables are functions that return them, since all columns of
    many cells together need a lot of memory.
    """
    arranged = arrange(experiment, rows.reset_index(drop=True))
    swept = [axis.column for axis in arranged.axes]
    cells = (arranged.rows if views.rows is None else views.rows).reset_index(drop=True)
    cells = cells.assign(**{name: arranged.rows[name].to_numpy() for name in swept if name not in cells})
    if "time_s" in cells:
        cells = cells.assign(unsteady=unsteady(cells).astype(float))
    columns = _columns(experiment, views, cells, swept)
    filters = _filters(cells, columns, swept)
    charts = [chart for chart in views.charts if len(chart.frame) and chart.on_page]
    drawn = {chart.name: _chart(chart) for chart in charts}
    identity = [name for name in dict.fromkeys((*IDENTITY, *swept)) if name in cells]
    needed = {"reason", "status", *identity, *filters, *(column[key] for column in columns for key in ("name", "flag"))}
    needed = needed.union(*map(_columns_of, drawn.values()))
    flags = {column["flag"] for column in columns}
    limits = {axis["limit"] for chart in drawn.values() for axis in (*chart["x"], *chart["y"])}
    limits |= {chart["failed"] for chart in drawn.values()}
    tables = {"rows": _encoded(cells, needed, flags | limits)}
    tables |= {
        chart.name: _encoded(_frame(chart), {"row", *_columns_of(drawn[chart.name])}, limits) for chart in charts
    }
    longest = max(map(len, commands), default=0)
    words = [[line[i] if i < len(line) else "" for line in commands] for i in range(longest)]
    return {
        "tables": tables,
        "columns": columns,
        "charts": list(drawn.values()),
        "filters": filters,
        "identity": identity,
        "command": {"head": reproduce.HEAD, "words": [encode(pd.Series(part, dtype=object)) for part in words]},
    }


# -------------------------------------------------------------------------------------------------------- columns


def _columns(experiment: Experiment, views: Views, cells: pd.DataFrame, swept: Sequence[str]) -> list[dict[str, str]]:
    """Return the columns of the table of cells: identity, the first results, status, the other results, the reason."""
    identity = [
        _column(name, name.replace("_", " "), "number" if pd.api.types.is_numeric_dtype(cells[name]) else "text")
        for name in varying_identity(cells, swept)
    ]
    own = views.columns or [
        c for c in experiment.columns.all if c.table and c.name not in COMMON and c.kind != "list" and c.name in cells
        and (cells[c.name].nunique() > 1 if c.kind == "text" else cells[c.name].notna().any())
    ]  # fmt: skip
    results = [_result(column, cells) for column in own]
    status, reason = (_column(name, name, "text") for name in ("status", "reason"))
    return [*identity[:IN_SIGHT], *results[:FIRST], status, *results[FIRST:], *identity[IN_SIGHT:], reason]


def _result(column: Column, cells: pd.DataFrame) -> dict[str, str]:
    if column.kind == "text":
        return _column(column.name, column.heading, "text")
    if column.format == "seconds":
        flag = "unsteady" if column.name == "time_s" and "unsteady" in cells else ""
        return _column(column.name, column.heading, "seconds", flag)
    return _column(column.name, column.heading, "limit" if column.limit else "number", column.limit)


def _column(name: str, label: str, kind: str, flag: str = "") -> dict[str, str]:
    """Return a column of kind text, number, seconds or limit.

    Where the column ``flag`` is not 0, seconds are marked with ``!`` and limits with ``<``.
    """
    return {"name": name, "label": label, "kind": kind, "flag": flag}


def _filters(cells: pd.DataFrame, columns: Sequence[dict[str, str]], swept: Sequence[str]) -> list[str]:
    """Return the columns to filter by: cell identity, swept parameters and verdicts of the table, where they vary.

    Columns with more than :data:`MOST` values and the column ``reason`` are omitted.
    """
    texts = [column["name"] for column in columns if column["kind"] == "text" and column["name"] != "reason"]
    names = dict.fromkeys((*IDENTITY, *swept, *texts, "experiment", "status"))
    return [name for name in names if name in cells and 1 < cells[name].nunique(dropna=False) <= MOST]


# --------------------------------------------------------------------------------------------------------- charts


def _frame(chart: Chart) -> pd.DataFrame:
    """Return a chart's table with the columns that join its lines, name its panels and colour its cells."""
    frame = chart.frame.reset_index(drop=True)
    frame = frame if "row" in frame else frame.assign(row=-1)
    key = [name for name in (chart.series, chart.line) if name]
    first, *rest = [frame[name].astype(str) for name in key] or [""]
    frame = frame.assign(line_=first.str.cat(rest, sep=" ") if rest else first, one_="")
    if chart.panel_row:
        frame = frame.assign(facet_=frame[chart.panel] + ", " + frame[chart.panel_row])
    return frame.assign(fill_=draw.cell_colours(chart)) if chart.kind == "grid" and chart.value else frame


def _chart(chart: Chart) -> dict[str, Any]:
    return {
        "title": chart.title or chart.name.replace("_", " ").capitalize(),
        "text": " ".join(
            filter(
                None,
                (chart.text, "" if chart.chosen or not chart.subtitle else f"Shown: {chart.subtitle.rstrip('.')}."),
            )
        ),
        "x": [_axis(column, chart) for column in chart.x],
        "y": [_axis(column, chart) for column in chart.y],
        "table": chart.name,
        "series": chart.series or "one_",
        "facet": "facet_" if chart.panel_row else chart.panel,
        "line": "line_" if chart.kind == "lines" else "",
        "front": chart.front,
        "failed": chart.failed,
        "level": chart.level,
        "fill": "fill_" if chart.kind == "grid" and chart.value else "",
        "cell": chart.cell,
        "join": chart.join,
        "marks": _marks(chart, "x"),
        "y_marks": _marks(chart, "y"),
        "own_scales": chart.own_scales,
        "looks": {name: _look(style) for name, style in draw.series_styles(chart).items()},
        "notes": dict(chart.panel_notes),
    }


def _columns_of(chart: dict[str, Any]) -> set[str]:
    axes = {axis[key] for axis in (*chart["x"], *chart["y"]) for key in ("column", "low", "high", "limit")}
    return axes | {chart[key] for key in ("series", "facet", "line", "front", "failed", "level", "fill", "cell")}


def _marks(chart: Chart, axis: str) -> dict[str, float | list[float | None]]:
    """Return the marks of an axis that all panels have: values, and ranges whose infinite end is None."""
    return {
        mark.name: mark.at if mark.to is None else [mark.at, mark.to if math.isfinite(mark.to) else None]
        for mark in chart.marks
        if mark.axis == axis and mark.panel is None
    }


def _axis(column: Column, chart: Chart) -> dict[str, Any]:
    values = chart.frame[column.name]
    is_text = not pd.api.types.is_numeric_dtype(values)
    log = not is_text and (is_logarithmic(values) if column.log is None else column.log)
    label = f"{column.heading} [s]" if column.format == "seconds" and not log else column.heading
    return {
        "column": column.name, "label": label, "log": log, "percent": column.format == "percent",
        "seconds": column.format == "seconds" and log,
        "low": column.low, "high": column.high, "limit": column.limit, "above_one": column.above_one,
    }  # fmt: skip


def _look(style: Style) -> dict[str, Any]:
    """Return the style of one series: its colours on a light and a dark background, symbol, dash, letter and meaning."""
    from matplotlib.colors import to_hex

    look = {
        "colour": [to_hex(style.colour), to_hex(DARK.get(style.colour, style.colour))],  # browsers know no grey "0.85"
        "symbol": SYMBOLS.get(style.marker, "circle") if style.marker else "line",
        "dash": DASHES.get(str(style.line), "dash"),
        "letter": style.letter,
        "meaning": style.meaning,
    }
    return {name: value for name, value in look.items() if value}


# ------------------------------------------------------------------------------------------------------- encoding


def _encoded(frame: pd.DataFrame, names: Collection[str], flags: Collection[str]) -> dict[str, Callable[[], Any]]:
    """Return functions that encode the columns ``names`` of a table."""

    def encoded(name: str) -> Any:
        return encode(frame[name].astype(float) if name in flags else frame[name])

    return {name: partial(encoded, name) for name in frame if name in names}


def encode(values: pd.Series) -> Any:
    """Encode a column for JSON: numbers rounded, None where missing; texts as distinct values and an index."""
    if pd.api.types.is_bool_dtype(values) or not pd.api.types.is_numeric_dtype(values):
        codes, unique = pd.factorize(values.astype(str))
        return {"values": list(unique), "index": codes.tolist()}
    codes, unique = pd.factorize(values)
    if 2 * len(unique) > len(values):
        return [_short(value) for value in values.tolist()]
    short = [*map(_short, unique.tolist()), None]  # the code of a missing number is -1, the last place
    return [short[code] for code in codes.tolist()]


def _short(value: float) -> float | int | None:
    if value is None or not math.isfinite(value):
        return None
    value = float(format(value, FORMAT))
    return int(value) if value.is_integer() and abs(value) < 1e15 else value
