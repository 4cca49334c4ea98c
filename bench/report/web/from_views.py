"""Turns what a study shows into the content of its page."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pandas as pd

from bench.experiment.columns import COMMON, Column
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Table, Views
from bench.report import draw
from bench.report.cells import readable
from bench.report.style import VARIANTS
from bench.report.views import arrange, is_logarithmic, unsteady
from bench.report.web import content as page

IN_SIGHT = 5
"""Most identity columns before the status and its reason, which a laptop then shows without scrolling."""


def content(experiment: Experiment, rows: pd.DataFrame, views: Views) -> page.Content:
    """Return the content of the page: findings, tables, charts, and the cells with their results."""
    shown = arrange(experiment, rows)
    cells = (shown.rows if views.rows is None else views.rows).reset_index(drop=True)
    if "time_s" in cells:
        cells = cells.assign(unsteady=unsteady(cells).astype(float))
    tables: dict[str, pd.DataFrame] = {}
    charts: list[page.Chart] = []
    looks: dict[str, dict[str, object]] = {}
    for chart in views.charts:
        if len(chart.frame) == 0 or not chart.on_page:
            continue
        tables[chart.name] = _table(chart)
        charts.append(_chart(chart))
        looks |= {name: _look(style) for name, style in draw.series_styles(chart).items()}
    own = views.columns or [
        c for c in experiment.columns.all if c.table and c.name not in COMMON and c.kind != "list" and c.name in cells
        and (cells[c.name].nunique() > 1 if c.kind == "text" else cells[c.name].notna().any())
    ]  # fmt: skip
    identity = page.identity_columns(cells, [axis.column for axis in shown.axes])
    results = [_column(column, cells) for column in own]
    answers = next((table for table in views.tables if table.page), None)
    return page.Content(
        finding="; ".join(views.findings),
        rows=cells,
        columns=[*identity[:IN_SIGHT], *results[:1], *page.STATUS, *results[1:], *identity[IN_SIGHT:]],
        charts=charts,
        answers=pd.DataFrame() if answers is None else _readable(answers),
        answers_title=answers.title if answers else "",
        tables=tables,
        looks=looks,
    )


def _readable(table: Table) -> pd.DataFrame:
    texts = readable(table)
    return texts.assign(**{"": table.frame[table.split].to_numpy()})[["", *texts]] if table.split else texts


def _table(chart: Chart) -> pd.DataFrame:
    frame = chart.frame.reset_index(drop=True)
    frame = frame if "row" in frame else frame.assign(row=-1)
    key = [name for name in (chart.series, chart.line) if name]
    frame = frame.assign(line_=_joined(frame, key) if key else "", one_="")
    if chart.panel_row:
        frame = frame.assign(facet_=frame[chart.panel] + ", " + frame[chart.panel_row])
    return frame.assign(fill_=draw.cell_colours(chart)) if chart.kind == "grid" and chart.value else frame


def _joined(frame: pd.DataFrame, columns: Sequence[str]) -> pd.Series:
    first, *rest = (frame[name].astype(str) for name in columns)
    return first.str.cat(rest, sep=" ") if rest else first


def _chart(chart: Chart) -> page.Chart:
    return page.Chart(
        title=chart.title,
        text=" ".join(filter(None, (chart.text, chart.subtitle))),
        x=[_axis(column, chart) for column in chart.x],
        y=[_axis(column, chart) for column in chart.y],
        table=chart.name,
        series=chart.series or "one_",
        facet="facet_" if chart.panel_row else chart.panel,
        line="line_" if chart.kind == "lines" else "",
        front=chart.front,
        level=chart.level,
        fill="fill_" if chart.kind == "grid" and chart.value else "",
        cell=chart.cell,
        join=chart.join,
        marks=_marks(chart, "x"),
        y_marks=_marks(chart, "y"),
    )


def _marks(chart: Chart, axis: str) -> dict[str, float | list[float | None]]:
    """Return the marks of an axis that all panels have: values, and ranges whose infinite end is None."""
    return {
        mark.name: mark.at if mark.to is None else [mark.at, mark.to if math.isfinite(mark.to) else None]
        for mark in chart.marks
        if mark.axis == axis and mark.panel is None
    }


def _axis(column: Column, chart: Chart) -> page.PlotAxis:
    values = chart.frame[column.name]
    is_text = not pd.api.types.is_numeric_dtype(values)
    log = not is_text and (is_logarithmic(values) if column.log is None else column.log)
    return page.PlotAxis(column.name, column.heading, log, column.low, column.high, column.limit, column.above_one)


def _column(column: Column, cells: pd.DataFrame) -> page.TableColumn:
    if column.kind == "text":
        return page.TableColumn(column.name, column.heading, "text")
    if column.format == "seconds":
        flag = "unsteady" if column.name == "time_s" and "unsteady" in cells else ""
        return page.TableColumn(column.name, column.heading, "seconds", flag)
    return page.TableColumn(column.name, column.heading, "limit" if column.limit else "number", column.limit)


def _look(style: Style) -> dict[str, object]:
    dashes = {str(line): name for line, name in zip(VARIANTS, ("solid", "dash", "dot"), strict=True)}
    return page.look(
        style.colour, page.SYMBOLS.get(style.marker, "circle") if style.marker else "line",
        dashes.get(str(style.line), "dash"), style.letter, style.meaning,
    )  # fmt: skip
