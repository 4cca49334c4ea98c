"""Draws charts, given as data, with Matplotlib.

A chart is drawn at any width: the panels are laid out again, and the text keeps its size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm, Normalize, to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import FixedLocator

from bench.experiment.columns import Column
from bench.experiment.views import Chart, Mark, Style
from bench.report.scales import log_axis
from bench.report.style import GREY, MARKERS, MARKS, SHADE, SIZE, colour, filled, plain, width_in_inches
from bench.report.text import axis_value, duration
from bench.report.views import is_logarithmic, pareto

WIDTH, NARROW = 7.16, 3.5
"""Figure widths in inches: two columns of a paper, or one."""
LINE = 0.155
"""Height of a line of text in inches."""
BOLD = 1.3
"""Width of a bold title relative to the same text elsewhere."""
UNLIMITED = 1e9
"""Factor on a value at which the bar of an interval without an upper end stops, beyond every logarithmic axis."""
BAND: dict[str, Any] = {"color": "#D55E00", "alpha": 0.12, "linewidth": 0}
"""Look of a named range of an axis."""
FRONT: dict[str, Any] = {"color": GREY, "linewidth": 0.8, "linestyle": "--"}
"""Look of the Pareto front."""
MANY = 12
"""Most points of a line that are drawn with markers; longer lines are drawn without."""


def draw(chart: Chart, width: float | None = None) -> Figure:
    """Return the chart as a figure of a width in inches: by default two columns of a paper, or one for a single panel."""
    chart, places = _numbered(replace(chart, frame=chart.drawn(), chosen=()))
    panels = _panels(chart)
    if width is None:
        width = NARROW if len(panels) == 1 and chart.kind in ("lines", "points") else WIDTH
    styles = series_styles(chart)
    row_names = list(dict.fromkeys(chart.frame[chart.panel_row].astype(str))) if chart.panel_row else []
    across = len(panels) // len(row_names) if row_names else _across(chart, len(panels), width)
    down = math.ceil(len(panels) / across)
    orders = [list(part[chart.y[0].name].unique()) for _, part in panels]
    same = all(order == orders[0] for order in orders)
    label_room = 0.42 * (width if same else width / across)
    draw_kind: Any = {
        "dots": partial(_draw_dots, room=label_room),
        "grid": partial(_draw_grid, width=width / across),
    }.get(chart.kind, _draw_lines)
    heights = [_height(chart, part) for _, part in panels]
    room = 0.9 * (width - _label_width(chart, row_names, 1 if same else across, label_room)) / across
    titles = [_panel_title(chart, name, room) for name, _ in panels[: across if row_names else None]]
    titles += [""] * (len(panels) - len(titles))  # of rows of panels, only the first has titles
    title_heights = [
        LINE * max(title.count("\n") + 1 if title else 0 for title in titles[i * across : (i + 1) * across])
        for i in range(down)
    ]
    head = _Head(chart, width)
    legend = _legend(chart, styles, width - 0.6)
    bands = dict.fromkeys(mark.name for mark in chart.marks if mark.to is not None)
    legend += [Patch(label=plain(name), **BAND) for name in bands]
    legend += [Line2D([], [], label="Pareto front", **FRONT)] * chart.front
    columns = _legend_columns([str(handle.get_label()) for handle in legend], width)
    heights = [height + 0.5 * max(map(width_in_inches, map(plain, places)), default=0.0) for height in heights]
    lines = [str(handle.get_label()).count("\n") + 1 for handle in legend]  # one column if any label is broken
    below = 0.05 + LINE * 1.12 * (math.ceil(len(legend) / columns) + sum(lines) - len(lines)) if legend else 0.0
    ratios = [max(heights[i * across : (i + 1) * across]) for i in range(down)]
    body = sum(ratios) + sum(title_heights) + 0.45
    if chart.kind == "grid":
        names = _categories(chart.x[0], chart.frame)
        labels = _grid_labels(chart, chart.x[0], names, width / across)
        body += LINE * max((label.count("\n") for label in labels), default=0)
    height = head.height + body + below
    layout = ConstrainedLayoutEngine(
        w_pad=0.04, h_pad=0.03, rect=(0.005, below / height, 0.99, 1 - (below + head.height) / height)
    )
    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    head.write(figure)
    shared = not chart.own_scales
    # quantities of the same runs above each other, so that their features can be compared
    stacked = chart.own_scales and across == 1 and chart.kind in ("lines", "points")
    grid = figure.subplots(
        down, across, squeeze=False, sharey=shared and chart.kind in ("lines", "points"),
        sharex=stacked or (shared and chart.kind == "dots"), height_ratios=ratios,
    ).ravel()  # fmt: skip
    for spare in grid[len(panels) :]:
        spare.remove()
    axes = list(grid[: len(panels)])
    for place, (panel, (name, part), title) in enumerate(zip(axes, panels, titles, strict=True)):
        if title:
            panel.set_title(title, loc="left", fontsize=SIZE)
        draw_kind(chart, panel, name, part, styles)
        if chart.kind == "dots" and same and place % across:
            panel.tick_params(labelleft=False)
        if chart.kind in ("lines", "points"):
            panel.set_xlabel("" if stacked and place < len(panels) - 1 else axis_text(chart.x[0]))
            panel.set_ylabel("" if place % across and shared else axis_text(chart.y[0]))
    if chart.kind in ("lines", "points"):
        _scale(chart, axes, panels)
        for panel in axes if places else ():
            panel.set_xlim(-0.3, len(places) - 0.7)
            panel.set_xticks(range(len(places)), list(map(plain, places)), rotation=30, ha="right")
            panel.set_xlabel("")
        for panel, (name, _) in zip(axes, panels, strict=True):
            _draw_marks(chart, panel, name)
    if shared and chart.kind in ("dots", "grid"):
        _label_outer(chart, axes, across, row_names)
    if legend:
        figure.legend(
            handles=legend, loc="lower center", bbox_to_anchor=(0.5, 0), ncols=columns, frameon=False,
            fontsize=SIZE, columnspacing=1.2, handletextpad=0.5, labelspacing=0.25, borderaxespad=0.1,
        )  # fmt: skip
    return figure


def _label_outer(chart: Chart, axes: Sequence[Axes], across: int, row_names: Sequence[str]) -> None:
    """Label the axes of panels with common scales at the left and lower edge only, and name the rows of panels."""
    labels = [[text.get_text() for text in panel.get_yticklabels()] for panel in axes]
    equal_rows = all(texts == labels[0] for texts in labels)
    for place, panel in enumerate(axes):
        if place + across < len(axes):
            panel.set_xlabel("")
        if chart.kind == "grid":
            panel.tick_params(labelbottom=place + across >= len(axes), labelleft=place % across == 0 or not equal_rows)
            if place % across:
                panel.set_ylabel("")
    if row_names:
        for panel, name in zip(axes[::across], row_names, strict=True):
            panel.set_ylabel(plain(name), rotation=0, ha="right", va="center")
        for place, panel in enumerate(axes):
            if place != len(axes) - 1 - across // 2:
                panel.set_xlabel("")
        figure = axes[0].figure.figure
        figure.supylabel(axis_text(chart.y[0]), fontsize=SIZE)


def series_styles(chart: Chart) -> dict[str, Style]:
    """Return a style for each series or level of a chart; those without a given style get a colour each."""
    column = chart.level if chart.kind == "grid" else chart.series
    names = list(dict.fromkeys(chart.frame[column].astype(str))) if column else [""]
    ordered = [name for name in chart.styles if name in names] + [name for name in names if name not in chart.styles]
    free = (i for i in range(1000) if colour(i) not in {style.colour for style in chart.styles.values()})
    return {
        name: chart.styles[name] if name in chart.styles else Style(colour(i := next(free)), MARKERS[i % len(MARKERS)])
        for name in ordered
    }


def _numbered(chart: Chart) -> tuple[Chart, list[str]]:
    """Return a chart of lines or points with the strings of its x replaced by their places, and the strings."""
    x = chart.x[0].name
    if chart.kind not in ("lines", "points") or pd.api.types.is_numeric_dtype(chart.frame[x]):
        return chart, []
    codes, names = pd.factorize(chart.frame[x])
    return replace(chart, frame=chart.frame.assign(**{x: codes.astype(float)})), list(map(str, names))


# ------------------------------------------------------------------------------------------------------- layout


class _Head:
    """The title and the subtitle above the panels."""

    def __init__(self, chart: Chart, width: float) -> None:
        self._width = width
        self._title = filled(chart.title.rstrip("."), 0.97 * width / BOLD)
        subtitle = ", ".join(filter(None, [chart.subtitle.rstrip("."), _grey(chart)]))
        self._subtitle = filled(subtitle, 0.97 * width) if subtitle else ""
        self._lines = self._title.count("\n") + 1
        self.height = (
            0.08 + LINE * 1.1 * self._lines + (LINE * (self._subtitle.count("\n") + 1) if self._subtitle else 0)
        )

    def write(self, figure: Figure) -> None:
        height = figure.get_size_inches()[1]
        top, left = 1 - 0.06 / height, 0.06 / self._width
        figure.text(left, top, plain_lines(self._title), ha="left", va="top", fontsize=SIZE + 1, fontweight="bold")
        if self._subtitle:
            below = top - LINE * 1.1 * self._lines / height
            figure.text(left, below, plain_lines(self._subtitle), ha="left", va="top", color=GREY)


def _grey(chart: Chart) -> str:
    """Return what the grey area of a chart means; nothing where no panel has one."""
    column = {"lines": chart.y[0], "points": chart.y[0], "dots": chart.x[0]}.get(chart.kind)
    if not column or not column.above_one or not _is_log(column, chart.frame[column.name]):
        return ""
    return f"grey: {column.above_one}" if _log_range(column, chart.frame)[1] > 1 else ""


def plain_lines(text: str) -> str:
    """Return text of several lines, escaped for Matplotlib."""
    return "\n".join(map(plain, text.split("\n")))


def _panels(chart: Chart) -> list[tuple[str, pd.DataFrame]]:
    if chart.panel_row:
        names = [list(dict.fromkeys(chart.frame[column])) for column in (chart.panel_row, chart.panel)]
        rows = {row: part for row, part in chart.frame.groupby(chart.panel_row, sort=False)}
        return [(str(name), rows[row][rows[row][chart.panel] == name]) for row in names[0] for name in names[1]]
    if not chart.panel:
        return [("", chart.frame)]
    return [(str(name), part) for name, part in chart.frame.groupby(chart.panel, sort=False)]


def _panel_title(chart: Chart, name: str, width: float) -> str:
    parts = [filled(_clipped(text, 3 * width), width) for text in (name, chart.panel_notes.get(name, "")) if text]
    return "\n".join(map(plain_lines, parts))


def _label_width(chart: Chart, row_names: Sequence[str], across: int, room: float) -> float:
    """Return the width in inches of the labels left of panels of dots, or of rows of panels: titles are right of them.

    Labels of dots have at most ``room`` inches each; ``across`` is the number of panels with labels in a row.
    """
    if row_names:
        return max(map(width_in_inches, map(plain, row_names))) + 0.6
    if chart.kind != "dots":
        return 0.7 if across == 1 else 0.0  # the numbers of the vertical axis
    names = map(str, chart.frame[chart.y[0].name].unique())
    return across * min(room, max(map(width_in_inches, map(plain, names)), default=0.0))


def _text_width(text: str) -> float:
    return max(map(width_in_inches, text.split("\n")))


def _across(chart: Chart, count: int, width: float) -> int:
    most = max(1, min(chart.across, count, round(chart.across * width / WIDTH)))
    return math.ceil(count / math.ceil(count / most))


def _height(chart: Chart, part: pd.DataFrame) -> float:
    """Return the height of a panel in inches."""
    if chart.height >= 1 or chart.kind in ("lines", "points"):
        return chart.height
    rows = chart.frame if chart.panel_row else part
    return float(chart.height * rows[chart.y[0].name].nunique() + 0.1)


def _legend(chart: Chart, styles: dict[str, Style], width: float) -> list[Any]:
    labels = {name: plain_lines(filled(style.meaning or name, width)) for name, style in styles.items()}
    if chart.kind == "grid":
        if not chart.level:
            return []
        return [
            Patch(facecolor=style.colour, edgecolor="#808080", linewidth=0.4, label=labels[name])
            for name, style in styles.items()
        ]
    if not chart.series or (chart.kind == "dots" and chart.series == chart.y[0].name):
        return []
    line = chart.kind == "lines"
    keys = [key for key in dict.fromkeys((chart.panel, chart.series, chart.line)) if key]
    bare = line and chart.frame.groupby(keys).size().min() > MANY
    colours = [
        Line2D(
            [], [], color=style.colour, marker="s" if chart.shape else "" if bare and style.line != "none" else style.marker,
            linestyle=style.line if line else "none", linewidth=style.width, label=labels[name],
        )
        for name, style in styles.items() if name
    ]  # fmt: skip
    return colours + [
        Line2D([], [], color=GREY, marker=mark, markerfacecolor="none", linestyle="none", label=plain(name))
        for name, mark in _shapes(chart).items()
    ]


def _shapes(chart: Chart) -> dict[str, str]:
    """Return a marker for each value of the column of shapes."""
    names = dict.fromkeys(chart.frame[chart.shape].astype(str)) if chart.shape else {}
    return {name: MARKERS[i % len(MARKERS)] for i, name in enumerate(names)}


def _legend_columns(labels: Sequence[str], width: float) -> int:
    lengths = np.array([0.5 + _text_width(label) for label in labels])
    for count in range(min(len(lengths), 8), 1, -1):
        if sum(part.max() for part in np.array_split(lengths, count)) <= width:
            return count
    return 1


def axis_text(column: Column) -> str:
    """Return the label of an axis."""
    return plain(column.heading)


def _values_text(column: Column) -> Any:
    if column.format == "seconds":
        return lambda value: duration(value).replace("us", "µs").replace(".0 ", " ")
    if column.format == "percent":
        return lambda value: f"{100 * value:g}%"
    return None


def _is_log(column: Column, values: Any) -> bool:
    values = np.asarray(values, dtype=float)
    positive = values[np.isfinite(values)]
    if column.log is None:
        return is_logarithmic(values)
    return column.log and bool(positive.size) and bool((positive > 0).any())


# -------------------------------------------------------------------------------------------- lines and points


def _draw_lines(chart: Chart, panel: Axes, name: str, part: pd.DataFrame, styles: dict[str, Style]) -> None:
    x, y = chart.x[0], chart.y[0]
    log = _is_log(y, (part if chart.own_scales else chart.frame)[y.name])
    keys = [key for key in dict.fromkeys((chart.series, chart.line, chart.shape)) if key]
    shapes = _shapes(chart)
    groups = part.groupby(keys, sort=False) if keys else [(("",), part)]
    for order, (key, points) in enumerate(groups):
        series = str(key[0]) if chart.series else ""
        style = styles[series]
        points = points.sort_values(x.name, kind="stable") if chart.kind == "lines" else points
        values, low, high, limit = _values(points, y, log)
        places = points[x.name].to_numpy(float)
        line = style.line if chart.kind == "lines" else "none"
        is_short = chart.kind == "points" or len(points) <= MANY or style.line == "none"
        mark = style.marker if is_short else ""
        mark = shapes[str(points[chart.shape].iloc[0])] if chart.shape else mark
        common: dict[str, Any] = {"color": style.colour, "zorder": 3 + 0.01 * order}
        panel.plot(places, values, linestyle=line, linewidth=style.width, **common)
        if mark:
            _mark(panel, places, values, limit, marker=mark, **common)
        if chart.band:
            panel.fill_between(places, low, high, color=style.colour, alpha=0.18, linewidth=0, zorder=2)
        else:
            known = np.isfinite(low)
            panel.vlines(places[known], low[known], high[known], linewidth=1.0, **common)
        lost = points[chart.failed].to_numpy(bool) if chart.failed else np.zeros(len(points), dtype=bool)
        if lost.any():
            panel.plot(
                places[lost], np.full(lost.sum(), 0.97), "x", transform=panel.get_xaxis_transform(), markersize=5,
                markeredgewidth=1.4, clip_on=False, **common,
            )  # fmt: skip
    if chart.front:
        known = part[np.isfinite(part[[x.name, y.name]]).all(axis=1)].sort_values(x.name)
        best = known[pareto(known[x.name], known[y.name])]
        panel.plot(best[x.name], best[y.name], zorder=2, **FRONT)


def _values(points: pd.DataFrame, column: Column, log: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a column's values, the ends of their intervals and which are limits; NaN where nothing can be drawn."""
    values = points[column.name].to_numpy(float)
    values = np.where(values > 0, values, np.nan) if log else values
    limit = points[column.limit].to_numpy(bool) if column.limit else np.zeros(len(points), dtype=bool)
    if not (column.low and column.high):
        return values, np.full(len(points), np.nan), np.full(len(points), np.nan), limit
    low, high = (points[end].to_numpy(float) for end in (column.low, column.high))
    if log:
        low, high = np.maximum(low, 1e-300), np.where(np.isinf(high), values * UNLIMITED, high)
    known = np.isfinite(values + low + high) & ~limit
    return values, np.where(known, low, np.nan), np.where(known, high, np.nan), limit


def _mark(panel: Axes, x: np.ndarray, y: np.ndarray, limit: np.ndarray, **look: Any) -> None:
    """Draw markers, hollow where the value is a limit."""
    panel.plot(x[~limit], y[~limit], linestyle="none", **look)
    panel.plot(x[limit], y[limit], linestyle="none", markerfacecolor="white", **look)


def _scale(chart: Chart, axes: Sequence[Axes], panels: Sequence[tuple[str, pd.DataFrame]]) -> None:
    """Set the scales of all panels: x per panel, y for all together unless the chart has scales per panel."""
    x = chart.x[0]
    few = all(part[x.name].nunique() <= 6 for _, part in panels)
    for panel, (_, part) in zip(axes, panels, strict=True):
        _scale_x(panel, x, part[x.name].to_numpy(float), few)
        _scale_values(chart, panel, "y", chart.y[0], part if chart.own_scales else chart.frame)


def _scale_values(chart: Chart, panel: Axes, which: Literal["x", "y"], column: Column, rows: pd.DataFrame) -> None:
    """Set the scale of the drawn quantity by its values in ``rows``, and shade the area above 1 where that means something."""
    text = _values_text(column)
    if _is_log(column, rows[column.name]):
        low, high = _log_range(column, rows, [mark for mark in chart.marks if mark.axis == which])
        log_axis(panel, which, low, high, text=text)
        if column.above_one and high > 1:
            (panel.axvspan if which == "x" else panel.axhspan)(1.0, high, zorder=0, **SHADE)
    elif text:
        (panel.xaxis if which == "x" else panel.yaxis).set_major_formatter(lambda value, _: text(value))


def _log_range(column: Column, rows: pd.DataFrame, marks: Sequence[Mark] = ()) -> tuple[float, float]:
    """Return the range of a logarithmic axis: all positive values, and their intervals within a factor of 100."""
    values = rows[column.name].to_numpy(float)
    values = values[np.isfinite(values) & (values > 0)]
    if not values.size:
        return 0.1, 10.0
    low, high = float(values.min()), float(values.max())
    for name in (column.low, column.high):
        if name:
            ends = rows[name].to_numpy(float)
            ends = ends[np.isfinite(ends) & (ends > 0) & (ends >= low / 100) & (ends <= high * 100)]
            low, high = min([low, *ends]), max([high, *ends])
    low, high = min([low, *(m.at for m in marks)]), max([high, *(m.at for m in marks)])
    margin = max((high / low) ** 0.06, 1.15)
    return low / margin, high * margin


def _scale_x(panel: Axes, column: Column, values: np.ndarray, few: bool) -> None:
    """Set the scale of x, with a label at each of the ``values`` if all panels have ``few``."""
    values = np.unique(values[np.isfinite(values)])
    if not values.size:
        return
    text = _values_text(column)
    if _is_log(column, values) and values[0] > 0:
        margin = max((values[-1] / values[0]) ** 0.05, 1.08)
        few = few and column.format == "setting"
        log_axis(panel, "x", values[0] / margin, values[-1] * margin, values if few else (), text)
        return
    spread = float(np.ptp(values)) or abs(float(values[0])) or 1.0
    panel.set_xlim(values[0] - 0.05 * spread, values[-1] + 0.05 * spread)
    if few:
        panel.xaxis.set_major_locator(FixedLocator(list(values)))
    if text:
        panel.xaxis.set_major_formatter(lambda value, _: text(value))


def _draw_marks(chart: Chart, panel: Axes, name: str) -> None:
    """Draw the named values and ranges of the axes, and the notes."""
    dashes = iter(MARKS * 10)
    for mark in chart.marks:
        if mark.panel not in (None, name):
            continue
        low, high = panel.get_xlim() if mark.axis == "x" else panel.get_ylim()
        if mark.to is not None:
            start, end = max(mark.at, low), min(mark.to, high)
            if start >= end:
                continue
            span = panel.axvspan if mark.axis == "x" else panel.axhspan
            span(start, end, zorder=0, **BAND)
        elif low < mark.at < high:
            # a mark without a name is a quiet line, not to be taken for a series
            dash, shade = (next(dashes), "#595959") if mark.name else ("-", "#c0c0c0")
            line = panel.axvline if mark.axis == "x" else panel.axhline
            line(mark.at, zorder=1, color=shade, linewidth=0.9, linestyle=dash)
            if mark.name:
                place, align = ((mark.at, 0.985), "top") if mark.axis == "x" else ((0.005, mark.at), "bottom")
                along = panel.get_xaxis_transform() if mark.axis == "x" else panel.get_yaxis_transform()
                panel.text(
                    *place, plain(f" {mark.name}"), transform=along, va=align, fontsize=SIZE - 0.5, color="#404040"
                )


# ---------------------------------------------------------------------------------------------------- dots


def _draw_dots(chart: Chart, panel: Axes, name: str, part: pd.DataFrame, styles: dict[str, Style], room: float) -> None:
    """Draw a row per category, the first at the top, with a dot and an interval per series.

    Names have ``room`` inches: wider ones are broken at a comma where the rows are high enough, and shortened.
    """
    x, y = chart.x[0], chart.y[0]
    categories = list(dict.fromkeys(part[y.name].astype(str)))
    place = {category: len(categories) - 1 - i for i, category in enumerate(categories)}
    values = chart.frame if not chart.own_scales else part
    log = _is_log(x, values[x.name])
    names = list(styles)
    several = len(names) > 1 and not chart.join
    if chart.join:
        for category, points in part.groupby(part[y.name].astype(str), sort=False):
            ends = points[x.name].to_numpy(float)
            ends = ends[np.isfinite(ends) & ((ends > 0) | (not log))]
            if len(ends) > 1:
                shade = styles[str(points[chart.series].iloc[-1])].colour if chart.series else "#000000"
                panel.hlines(
                    place[str(category)], ends.min(), ends.max(), color=shade, alpha=0.45, linewidth=1.8, zorder=1
                )
    for number, (series, style) in enumerate(styles.items()):
        points = part[part[chart.series].astype(str) == series] if chart.series else part
        if points.empty:
            continue
        shift = 0.0
        if several and part[y.name].nunique() < len(part):
            shift = -0.5 * (number - (len(names) - 1) / 2) / max(len(names), 2)
        rows = np.array([place[str(v)] for v in points[y.name]]) + shift
        at, low, high, limit = _values(points, x, log)
        common: dict[str, Any] = {"color": style.colour, "zorder": 3}
        known = np.isfinite(low)
        panel.hlines(rows[known], low[known], high[known], linewidth=1.0, **common)
        _mark(panel, at, rows, limit, marker=style.marker or "o", **common)
        for row in rows[points[chart.failed].to_numpy(bool)] if chart.failed else ():
            panel.plot([0.985], [row], "x", transform=panel.get_yaxis_transform(), color=style.colour, markersize=5)
    labels = [_in_lines(category, room, int(chart.height / LINE)) for category in place]
    panel.set_yticks(list(place.values()), labels)
    panel.set_ylim(-0.6, len(categories) - 0.4)
    panel.tick_params(axis="y", length=0)
    panel.grid(axis="y", color="#e4e4e4", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.set_xlabel(axis_text(x))
    _scale_values(chart, panel, "x", x, values)
    _draw_marks(chart, panel, name)


# ---------------------------------------------------------------------------------------------------- grid


def _draw_grid(
    chart: Chart, panel: Axes, name: str, part: pd.DataFrame, styles: dict[str, Style], width: float = WIDTH
) -> None:
    """Draw a cell per pair of x and y, coloured by level or value, with its text."""
    x, y = chart.x[0], chart.y[0]
    across, down = (
        _categories(x, part if chart.own_scales else chart.frame),
        _categories(y, chart.frame if chart.panel_row else part, downwards=True),
    )
    norm = _norm(chart)
    every = _categories(y, chart.frame, downwards=True)  # the panels of a column have labels of one width
    panel_width = _inner_width(panel, _grid_labels(chart, y, every, width))
    cell_width, cell_height = panel_width / max(len(across), 1), _height(chart, part) / max(len(down), 1)
    widest = max(map(width_in_inches, map(str, chart.frame[chart.cell])), default=0.0) if chart.cell else 0.0
    size = min(SIZE - 1, 0.8 * 72 * cell_width, SIZE * 0.92 * cell_width / max(widest, 0.1))
    for line in part.to_dict("records"):
        place = across.index(_category(line[x.name])), len(down) - 1 - down.index(_category(line[y.name]))
        if chart.level:
            style = styles[str(line[chart.level])]
            face, text = style.colour, line[chart.cell] if chart.cell else style.letter
        else:
            value = float(line[chart.value])
            face = _shade(norm, value)
            text = line[chart.cell] if chart.cell else ""
        panel.add_patch(
            Rectangle((place[0] - 0.5, place[1] - 0.5), 1, 1, facecolor=face, edgecolor="white", linewidth=0.8)
        )
        if text:
            panel.text(*place, plain(str(text)), ha="center", va="center", color=ink_on(face), fontsize=size)
    panel.set_xlim(-0.5, len(across) - 0.5)
    panel.set_ylim(-0.5, len(down) - 0.5)
    for which, column, names in (("x", x, across), ("y", y, down[::-1])):
        labels = _grid_labels(chart, column, names, width)
        if which == "x" and any("…" in label for label in labels) and max(map(width_in_inches, names)) < 1.6:
            labels = [plain(name) for name in names]  # short names read upwards rather than shortened
            panel.tick_params(axis="x", rotation=90)
        step = 1
        if column.kind == "number":  # of numbers that would overlap, each second or more is shown
            needed = max(map(width_in_inches, labels)) + 0.08 if which == "x" else 0.8 * LINE
            step = math.ceil(needed / (cell_width if which == "x" else cell_height))
        getattr(panel, f"set_{which}ticks")(range(0, len(labels), step), labels[::step])
        if column.label or column.kind == "number":
            getattr(panel, f"set_{which}label")(axis_text(column))
    panel.tick_params(length=0)
    for spine in panel.spines.values():
        spine.set_visible(False)


def _grid_labels(chart: Chart, column: Column, names: Sequence[str], width: float) -> list[str]:
    """Return the labels of an axis of a grid, y labels beside at most half of it, x labels in lines as wide as a cell."""
    widest = min(3.0, max(0.45 * width, 1.2 if chart.own_scales else 2.1))
    if column is chart.y[0] or column.kind != "text":
        return [plain(_clipped(name, widest)) for name in names]
    beside = min(widest, max(map(width_in_inches, map(plain, _categories(chart.y[0], chart.frame))), default=0.0))
    if chart.panel and not chart.own_scales:  # the labels beside the first panel serve all
        across = max(1, round(WIDTH / width))
        beside /= across
    room = max(0.3, (width - beside - 0.15) / len(names) - 0.06)
    return [
        "\n".join(plain(_clipped(line, room)) for line in filled(name, room, r"_,\[ ").split("\n", 4)[:5])
        for name in names
    ]


def _in_lines(text: str, width: float, most: int) -> str:
    """Break a name at commas into at most ``most`` lines, and shorten those wider than ``width`` inches."""
    lines = filled(text, width).split("\n")
    lines = [*lines[: most - 1], " ".join(lines[most - 1 :])] if most > 1 else [text]
    return "\n".join(plain(_clipped(line, width)) for line in lines if line)


def _clipped(text: str, width: float) -> str:
    """Shorten text that is wider than ``width`` inches, with an ellipsis in its middle."""
    full = width_in_inches(plain(text))
    if full <= width:
        return text
    kept = max(4, int(len(text) * width / full) - 2)
    return f"{text[: (kept + 1) // 2]}…{text[len(text) - kept // 2 :]}"


def _inner_width(panel: Axes, labels: Sequence[str]) -> float:
    """Return about the width of a panel in inches, before the layout, from the labels left of the first one."""
    place, width = panel.get_subplotspec(), panel.figure.figure.get_size_inches()[0]
    across = place.get_gridspec().ncols if place is not None else 1
    return max(0.9 * (float(width) - max(map(width_in_inches, labels), default=0.0)) / across, 0.2)


def _category(value: Any) -> str:
    return axis_value(float(value)) if isinstance(value, int | float | np.number) else str(value)


def _categories(column: Column, rows: pd.DataFrame, downwards: bool = False) -> list[str]:
    """Return the categories of an axis in order: strings as they appear, numbers increasing, or downwards decreasing."""
    values = rows[column.name].drop_duplicates()
    if pd.api.types.is_numeric_dtype(values):
        return list(dict.fromkeys(map(_category, sorted(values.dropna(), reverse=downwards))))
    return list(map(str, values))


def _norm(chart: Chart) -> Normalize:
    if chart.value_range:
        return LogNorm(*chart.value_range, clip=True)
    values = chart.frame[chart.value].to_numpy(float) if chart.value else np.array([1.0])
    values = values[np.isfinite(values)]
    if not values.size:
        return Normalize(0, 1)
    low, high = float(values.min()), float(values.max())
    return LogNorm(low, high) if low > 0 and high > 8 * low else Normalize(low, high if high > low else low + 1)


def _shade(norm: Normalize, value: float) -> str:
    from matplotlib import colormaps

    if not math.isfinite(value):
        return "#f0f0f0"
    return to_hex(colormaps["YlOrBr"](0.08 + 0.84 * float(norm(value))))


def ink_on(ground: str) -> str:
    """Return black or white, whichever contrasts more with a colour."""
    r, g, b = to_rgb(ground)
    return "#000000" if 0.3 * r + 0.59 * g + 0.11 * b > 0.5 else "#ffffff"
