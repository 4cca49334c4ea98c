"""Draws charts, given as data, with Matplotlib.

No text is cut: a long one breaks into lines, and what it names gets higher.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import FixedLocator

from bench.experiment.columns import Column
from bench.experiment.views import Chart, Mark, Style
from bench.report.colours import looks_by_name
from bench.report.scales import log_axis
from bench.report.style import GREY, MARKERS, MARKS, SHADE, SIZE, filled, plain, width_in_inches
from bench.report.text import axis_value, number, short_duration
from bench.report.views import is_logarithmic

WIDTH, NARROW = 7.16, 3.5
"""Figure widths in inches: two columns of a paper, or one."""
PAD = 0.045
"""Space above and below texts in inches."""
LINE = 0.155
"""Height of a line of text in inches."""
BOLD = 1.3
"""Width of a bold title relative to the same text elsewhere."""
UPWARDS = (1.0, 1.6, 2.4, 3.2, math.inf)
"""Lengths in inches of labels that read upwards, the first that fits."""
DOT = 0.075
"""Height in inches of a series in a row of dots."""
BELOW = 0.35
"""Height of further quantities below the first, relative to its height."""
UNLIMITED = 1e9
"""Factor on a value at which the bar of an interval without an upper end stops, beyond every logarithmic axis."""
BAND: dict[str, Any] = {"color": "#D55E00", "alpha": 0.12, "linewidth": 0}
"""Look of a named range of an axis."""
USELESS = 1e2
"""Where a value above 1 means a failure, larger values are drawn here with their number."""
NAME = 0.8
"""Longest line of a name at a point, in inches."""
BEHIND: dict[str, Any] = {"facecolor": "#ffffff", "alpha": 0.7, "linewidth": 0, "pad": 0.5}
"""Look of the ground of a name at a point, which may cross an arrow."""
NEAR = 0.2
"""Distance in inches from which an arrow joins two points."""
LIMIT: dict[str, Any] = {"color": "#000000", "linewidth": 1.4}
"""Look of a limit across a grid."""
MANY = 12
"""Most points of a line that are drawn with markers; longer lines are drawn without."""


def draw(chart: Chart, is_narrow: bool = False) -> Figure:
    """Return the chart as a figure, two columns of a paper wide, or one for plots without panels side by side.

    If ``is_narrow`` it is one column wide, with one panel across.
    """
    panels = [(str(name), part) for name, part in chart.frame.groupby(chart.panel, sort=False)] if chart.panel else []
    panels = panels or [("", chart.frame)]
    is_plot = chart.kind in ("lines", "points")
    quantities = [chart.y[0]] * len(panels)
    if chart.own_scales and not chart.panel:
        panels, quantities = panels * len(chart.y), list(chart.y)
    most = 1 if is_narrow or not chart.panel else chart.across
    width = NARROW if is_narrow or (is_plot and (len(panels) == 1 or not chart.panel)) else WIDTH
    down = math.ceil(len(panels) / max(1, min(most, len(panels))))
    across = math.ceil(len(panels) / down)
    styles = looks_by_name([chart])

    rows = [[] if is_plot else _categories(chart.y[0], part, downwards=True) for _, part in panels]
    # panels with the same rows have labels once, at the left
    shared = not chart.own_scales if is_plot else all(names == rows[0] for names in rows)
    beside = 1 if shared else across
    room = (0.46 if shared else 0.42 / across) * width
    labels = [[_wrapped(name, room) for name in names] for names in rows]
    written = [text for names in labels for text in names]
    inner = (width - beside * (0.7 if is_plot else max(map(_text_width, written), default=0.0))) / across - 0.12
    is_spread = chart.kind == "dots" and not chart.join and chart.series not in ("", chart.y[0].name)
    row = max(
        [chart.height, DOT * len(styles) * is_spread, *(LINE * (1 + text.count("\n")) + 0.015 for text in written)]
    )
    heights = [chart.height if is_plot else row * len(names) + 0.1 for names in rows]
    heights = [height if y is chart.y[0] else BELOW * height for height, y in zip(heights, quantities, strict=True)]

    # quantities of the same runs above each other have one scale of x, so that their features can be compared
    stacked = chart.own_scales and is_plot
    ratios = [max(heights[i * across : (i + 1) * across]) for i in range(down)]
    engine = ConstrainedLayoutEngine(w_pad=0.04, h_pad=PAD, rect=(0.006, 0, 0.988, 1))
    figure = Figure(figsize=(width, 4 + 2 * sum(ratios)), layout=engine)
    FigureCanvasAgg(figure)
    grid = figure.subplots(
        down, across, squeeze=False, sharey=is_plot and shared, height_ratios=ratios,
        sharex=stacked or (not chart.own_scales and chart.kind == "dots"),
    ).ravel()  # fmt: skip
    for spare in grid[len(panels) :]:
        spare.remove()
    for place, (panel, (name, part), names, y) in enumerate(zip(grid, panels, rows, quantities, strict=False)):
        is_left, is_last = place % across == 0 or not shared, place + across >= len(panels)
        title = "\n".join(
            _wrapped(text, inner)
            for text in (name, chart.panel_notes.get(name, ""))
            if text and (len(panels) > 1 or not chart.subtitle.startswith(text))
        )
        panel.set_title(title, loc="left", fontsize=SIZE)
        if is_plot:
            _draw_lines(chart, panel, part, styles, y)
            few = all(p[chart.x[0].name].nunique() <= 6 for _, p in panels)
            _scale_x(panel, chart.x[0], part[chart.x[0].name], few, bool(chart.arrow))
            _scale_values(chart, panel, "y", y, part if chart.own_scales else chart.frame)
            if y is not chart.y[0]:
                panel.margins(y=0.4)
            elif chart.arrow:
                _draw_arrows(chart, panel, part, styles, np.array([inner, heights[place]]))
            panel.set_xlabel("" if stacked and not is_last else _wrapped(chart.x[0].heading, inner))
            panel.set_ylabel(_wrapped(y.heading, heights[place]) if is_left else "")
        else:
            panel.set_yticks(range(len(names)), labels[place][::-1])
            panel.set_ylim(-0.5, len(names) - 0.5)
            panel.tick_params(axis="y", length=0, labelleft=is_left)
            is_named = is_left and (chart.y[0].label or chart.y[0].kind == "number")
            panel.set_ylabel(_wrapped(chart.y[0].heading, heights[place]) if is_named else "")
            cells = {label: len(names) - 1 - i for i, label in enumerate(names)}
            if chart.kind == "dots":
                _draw_dots(chart, panel, part, styles, cells)
            else:
                _draw_grid(chart, panel, part, styles, cells, inner)
            panel.tick_params(labelbottom=is_last or chart.own_scales)
            if not is_last and not chart.own_scales:
                panel.set_xlabel("")
        _draw_marks(chart, panel, name)
    _frame(figure, chart, _legend(chart, styles, width))
    engine.execute(figure)
    drawn = figure.get_figheight() * sum(panel.get_position().height for panel in grid[::across])
    figure.set_figheight(figure.get_figheight() + sum(ratios) - drawn)
    figure.texts[0].set_y(1 - PAD / figure.get_figheight())
    return figure


# ------------------------------------------------------------------------------------- title, legend and texts


def _frame(figure: Figure, chart: Chart, legend: Sequence[Any]) -> None:
    """Write title and subtitle above the panels, and the legend below them."""
    width = figure.get_figwidth()
    title = _wrapped(chart.title.rstrip("."), 0.97 * width / BOLD)
    subtitle = _wrapped(", ".join(filter(None, [chart.subtitle.rstrip("."), *_signs(chart)])), 0.97 * width)
    look: dict[str, Any] = {"x": 0.06 / width, "ha": "left", "va": "top"}
    figure.text(y=1, s=title, fontsize=SIZE + 1, fontweight="bold", **look)
    # blank lines leave the place of the title
    below = "\n".join([" "] * (title.count("\n") + 1) + [subtitle] * bool(subtitle))
    figure.suptitle(below, fontsize=SIZE, color=GREY, linespacing=1.35, **look)
    if legend:
        figure.legend(
            handles=legend, loc="outside lower center", ncols=_legend_columns([str(handle.get_label()) for handle in legend], width),
            frameon=False, fontsize=SIZE, columnspacing=1.2, handletextpad=0.5, labelspacing=0.25, borderaxespad=0.1,
        )  # fmt: skip


def _wrapped(text: str, width: float, ends: str = r" ,/\[") -> str:
    """Return text in lines of at most ``width`` inches, escaped for Matplotlib."""
    return "\n".join(map(plain, filled(text, width, ends).split("\n")))


def _text_width(text: str) -> float:
    return max(map(width_in_inches, text.split("\n")))


def _signs(chart: Chart) -> list[str]:
    """Return what a grey area and hollow markers mean, where the chart has them."""
    column = {"lines": chart.y[0], "points": chart.y[0], "dots": chart.x[0]}.get(chart.kind)
    if not column:
        return []
    is_grey = column.above_one and _is_log(column, chart.frame[column.name]) and _log_range(column, chart.frame)[1] > 1
    values = chart.frame[column.name]
    is_hollow = (column.limit and chart.frame[column.limit].eq(True).any()) or (
        column.least and (values < column.least).any()
    )
    return [f"grey: {column.above_one}"] * bool(is_grey) + ["hollow: an upper limit"] * bool(is_hollow)


def _legend(chart: Chart, styles: dict[str, Style], width: float) -> list[Any]:
    """Return the handles of the legend: series or levels, the front, and named values and ranges of the axes."""
    named = {name: style for name, style in styles.items() if name and not chart.arrow}
    labels = {name: _wrapped(style.meaning or name, width - 0.6) for name, style in named.items()}
    handles: list[Any] = []
    if chart.kind == "grid":
        looks: dict[str, Any] = {"edgecolor": "#808080", "linewidth": 0.4}
        handles = [Patch(facecolor=styles[name].colour, label=label, **looks) for name, label in labels.items()]
    elif chart.kind != "dots" or chart.series != chart.y[0].name:
        keys = [key for key in dict.fromkeys((chart.panel, chart.series, chart.line)) if key]
        is_line = chart.kind == "lines"
        bare = is_line and keys and chart.frame.groupby(keys).size().min() > MANY
        for name, label in labels.items():
            style = styles[name]
            mark = "" if bare and style.line != "none" else style.marker
            line: Any = style.line if is_line else "none"
            handles.append(
                Line2D([], [], color=style.colour, marker=mark, linestyle=line, linewidth=style.width, label=label)
            )
    if chart.arrow:
        laws = zip(MARKERS, chart.frame[chart.line].unique(), strict=False)
        handles += [
            Line2D([], [], color=GREY, marker=marker, linestyle="none", label=plain(str(law))) for marker, law in laws
        ]
    handles += [Line2D([], [], label=chart.limit_name, **LIMIT)] * bool(
        chart.limit and (chart.frame[chart.limit] > 0).any()
    )
    ranges = dict.fromkeys(mark.name for mark in chart.marks if mark.to is not None)
    handles += [Line2D([], [], label=plain(name), **look) for name, look in _mark_looks(chart).items() if name]
    return handles + [Patch(label=plain(name), **BAND) for name in ranges]


def _legend_columns(labels: Sequence[str], width: float) -> int:
    lengths = np.array([0.5 + _text_width(label) for label in labels])
    for count in range(min(len(lengths), 8), 1, -1):
        if sum(part.max() for part in np.array_split(lengths, count)) <= width:
            return count
    return 1


# ------------------------------------------------------------------------------------------------------ scales


def _values_text(column: Column, largest: float) -> Any:
    """Return the function that formats the numbers of an axis; None for plain numbers."""
    if column.format == "seconds":
        return short_duration
    if column.format == "percent":
        return lambda value: f"{100 * value:g}%"
    return axis_value if largest >= 1e5 else None


def _is_log(column: Column, values: Any) -> bool:
    values = np.asarray(values, dtype=float)
    if column.log is None:
        return is_logarithmic(values)
    return column.log and bool((np.isfinite(values) & (values > 0)).any())


def _scale_values(chart: Chart, panel: Axes, which: Literal["x", "y"], column: Column, rows: pd.DataFrame) -> None:
    """Set the scale of the drawn quantity by its values in ``rows``, and shade the area above 1 where that means something."""
    if _is_log(column, rows[column.name]):
        low, high = _log_range(column, rows, [mark for mark in chart.marks if mark.axis == which])
        log_axis(panel, which, low, high, text=_values_text(column, 0.0))
        if column.above_one and high > 1:
            (panel.axvspan if which == "x" else panel.axhspan)(1.0, high, zorder=0, **SHADE)
    elif text := _values_text(column, rows[column.name].abs().max()):
        (panel.xaxis if which == "x" else panel.yaxis).set_major_formatter(lambda value, _: text(value))


def _log_range(column: Column, rows: pd.DataFrame, marks: Sequence[Mark] = ()) -> tuple[float, float]:
    """Return the range of a logarithmic axis: all positive values, and their intervals within a factor of 100."""
    values = rows[column.name].clip(column.least, USELESS if column.above_one else None).to_numpy(float)
    values = values[np.isfinite(values) & (values > 0)]
    if not values.size:
        return 0.1, 10.0
    low, high = float(values.min()), float(values.max())
    ends = rows[[name for name in (column.low, column.high) if name]].to_numpy(float).ravel()
    ends = ends[np.isfinite(ends) & (ends >= low / 100) & (ends <= (USELESS if column.above_one else high * 100))]
    every = [low, high, *ends, *(mark.at for mark in marks)]
    margin = max((max(every) / min(every)) ** 0.06, 1.15)
    return min(every) / margin, max(every) * margin


def _scale_x(panel: Axes, column: Column, values: pd.Series, few: bool, is_named: bool) -> None:
    """Set the scale of x, with a label at each of the ``values`` if all panels have ``few``, and room for names at points."""
    if not pd.api.types.is_numeric_dtype(values):
        panel.tick_params(axis="x", rotation=30)
        return
    places = np.unique(values[np.isfinite(values)])
    if not places.size:
        return
    if _is_log(column, places) and places[0] > 0:
        margin = max((places[-1] / places[0]) ** 0.05, 1.08)
        before, after = (margin**2, margin**7) if is_named else (margin, margin)
        wanted = places if few and column.format == "setting" else ()
        log_axis(panel, "x", places[0] / before, places[-1] * after, wanted, _values_text(column, 0.0))
        return
    if few:
        panel.xaxis.set_major_locator(FixedLocator(list(places)))
    if text := _values_text(column, places[-1]):
        panel.xaxis.set_major_formatter(lambda value, _: text(value))


def _mark_looks(chart: Chart) -> dict[str, dict[str, Any]]:
    """Return the look of each name of marked values; those without a name are quiet lines, not to be taken for a series."""
    names = list(dict.fromkeys(mark.name for mark in chart.marks if mark.name and mark.to is None))
    looks = {name: {"color": "#595959", "linestyle": MARKS[i % len(MARKS)]} for i, name in enumerate(names)}
    return {name: look | {"linewidth": 0.9} for name, look in looks.items()} | {
        "": {"color": "#c0c0c0", "linewidth": 0.9}
    }


def _draw_marks(chart: Chart, panel: Axes, name: str) -> None:
    """Draw the named values and ranges of the axes."""
    looks = _mark_looks(chart)
    for mark in chart.marks:
        low, high = panel.get_xlim() if mark.axis == "x" else panel.get_ylim()
        if mark.panel not in (None, name):
            continue
        if mark.to is None and low < mark.at < high:
            (panel.axvline if mark.axis == "x" else panel.axhline)(mark.at, zorder=1, **looks[mark.name])
        elif mark.to is not None and max(mark.at, low) < min(mark.to, high):
            span = panel.axvspan if mark.axis == "x" else panel.axhspan
            span(max(mark.at, low), min(mark.to, high), zorder=0, **BAND)


# -------------------------------------------------------------------------------------------- lines and points


def _draw_lines(chart: Chart, panel: Axes, part: pd.DataFrame, styles: dict[str, Style], y: Column) -> None:
    x = chart.x[0]
    log = _is_log(y, (part if chart.own_scales else chart.frame)[y.name])
    keys = [key for key in dict.fromkeys((chart.series, chart.line)) if key]
    laws = list(chart.frame[chart.line].unique()) if chart.arrow else []
    for order, (key, points) in enumerate(part.groupby(keys, sort=False) if keys else [(("",), part)]):
        style = styles[str(key[0]) if chart.series else ""]
        if chart.arrow:
            style = replace(style, marker=MARKERS[laws.index(key[1])])
        is_line, is_number = chart.kind == "lines", pd.api.types.is_numeric_dtype(points[x.name])
        points = points.sort_values(x.name, kind="stable") if is_line and is_number else points
        mark = style.marker if not is_line or len(points) <= MANY or style.line == "none" else ""
        _draw_values(chart, panel, points, y, log, points[x.name].to_numpy(), style, mark, 3 + 0.01 * order)


def _draw_arrows(chart: Chart, panel: Axes, part: pd.DataFrame, styles: dict[str, Style], size: np.ndarray) -> None:
    """Join the two points of each arrow of a panel of ``size`` (2,) inches, and name the series beside the first of them.

    Of the places at a point the name is where fewest points, arrows and other names are.
    """
    low, high = (np.log(ends) for ends in zip(panel.get_xlim(), panel.get_ylim(), strict=True))
    taken: list[tuple[np.ndarray, np.ndarray]] = []
    named: list[tuple[str, np.ndarray]] = []
    for _, points in part.groupby(chart.arrow, sort=False):
        ends = points[[chart.x[0].name, chart.y[0].name]].to_numpy(float, copy=True)
        if chart.y[0].above_one:
            ends[:, 1] = ends[:, 1].clip(chart.y[0].least, USELESS)
        series, places = str(points[chart.series].iloc[0]), (np.log(ends) - low) / (high - low) * size
        if np.ptp(places, axis=0).max() > NEAR:
            look = {"arrowstyle": "-|>", "color": styles[series].colour, "linewidth": 1.6, "shrinkA": 3, "shrinkB": 3}
            panel.annotate("", ends[-1], ends[0], arrowprops=look, zorder=2)
        taken.append((places.min(axis=0) - 0.05, places.max(axis=0) + 0.05))
        named.append((series, places[0]))
    for series, place in named:
        text = _wrapped(series, NAME, r"_ ,/\[")
        width, height = extent = np.array([_text_width(text), 0.14 * (text.count("\n") + 1)])
        across, along = (0.08, -width / 2, -width - 0.08), (-height / 2, 0.08, -height - 0.08)
        starts = [place + side for side in product(across, along) if side != (across[1], along[0])]
        outside = [((start < 0) | (start + extent > size)).any() for start in starts]
        crossed = [sum((start < b).all() and (start + extent > a).all() for a, b in taken) for start in starts]
        _, _, best = min(zip(outside, crossed, range(8), strict=True))
        taken.append((starts[best], starts[best] + extent))
        x, y = starts[best] / size
        written = panel.text(x, y, text, transform=panel.transAxes, color=styles[series].colour, bbox=BEHIND)
        written.set_in_layout(False)


def _draw_values(
    chart: Chart,
    panel: Axes,
    points: pd.DataFrame,
    column: Column,
    log: bool,
    places: np.ndarray,
    style: Style,
    marker: str,
    zorder: float,
) -> None:
    """Draw the values of a column at ``places`` of the other axis, with intervals; limits are hollow, failures crosses at the edge."""
    values = points[column.name].to_numpy(float)
    limit, lost = (
        points[name].to_numpy(bool) if name else np.zeros(len(points), bool) for name in (column.limit, chart.failed)
    )
    least, most = (column.least, USELESS if column.above_one else math.inf) if log else (0.0, math.inf)
    is_zero, is_cut = log & (values <= least), values > most
    given, values = values, np.where(is_zero & (least == 0), np.nan, values.clip(least, most) if log else values)
    limit, is_zero = limit | is_zero, is_zero & (least == 0)
    is_flat = chart.kind == "dots"
    edge = panel.get_yaxis_transform() if is_flat else panel.get_xaxis_transform()
    look: dict[str, Any] = {"color": style.colour, "zorder": zorder}

    def plot(at: Any, value: Any, **more: Any) -> None:
        panel.plot(*((value, at) if is_flat else (at, value)), **look | more)

    if chart.kind == "lines":
        plot(places, values, linestyle=style.line, linewidth=style.width)
    for these, face in ((~limit, {}), (limit, {"markerfacecolor": "white"})) if marker else ():
        plot(places[these], values[these], marker=marker, linestyle="none", **face)
    if column.low and column.high:
        low, high = (points[end].to_numpy(float) for end in (column.low, column.high))
        if log:
            low, high = np.maximum(low, 1e-300), np.where(np.isinf(high), values * UNLIMITED, high)
        known = np.isfinite(values + low + high) & ~limit
        if chart.band:
            low, high = (np.where(known, end, np.nan) for end in (low, high))
            panel.fill_between(places, low, high, color=style.colour, alpha=0.18, linewidth=0, zorder=2)
        else:
            (panel.hlines if is_flat else panel.vlines)(places[known], low[known], high[known], linewidth=1.0, **look)
    if is_zero.any():  # below every value of the axis
        plot(
            places[is_zero],
            np.full(is_zero.sum(), 0.03),
            marker=marker or "o",
            linestyle="none",
            transform=edge,
            markerfacecolor="white",
        )
    if is_cut.any():
        last = int(np.nanargmax(np.where(is_cut, given, np.nan)))
        at = (values[last], places[last]) if is_flat else (places[last], values[last])
        down = 3 + 9 * sum(text.get_gid() == "cut" for text in panel.texts)
        where: Any = {"xytext": (0, 4), "ha": "center"} if chart.arrow else {"xytext": (4, -down), "va": "top"}
        panel.annotate(
            number(given[last]) + " ↑" * (not chart.arrow),
            at,
            textcoords="offset points",
            color=style.colour,
            gid="cut",
            **where,
        )
    if lost.any():
        plot(places[lost], np.full(lost.sum(), 0.97), marker="x", linestyle="none", transform=edge, markersize=5,
             markeredgewidth=1.4, clip_on=False)  # fmt: skip


# ----------------------------------------------------------------------------------------------- dots and grids


def _draw_dots(chart: Chart, panel: Axes, part: pd.DataFrame, styles: dict[str, Style], place: dict[str, int]) -> None:
    """Draw a row per category, with a dot and an interval per series."""
    x, y = chart.x[0], chart.y[0]
    values = part if chart.own_scales else chart.frame
    log = _is_log(x, values[x.name])
    if chart.join:
        for category, points in part.groupby(part[y.name].astype(str), sort=False):
            ends = points[x.name].clip(x.least).to_numpy(float)
            ends = ends[np.isfinite(ends) & ((ends > 0) | (not log))]
            if len(ends) > 1:
                shade = styles[str(points[chart.series].iloc[-1])].colour if chart.series else "#000000"
                look: dict[str, Any] = {"color": shade, "alpha": 0.45, "linewidth": 1.8, "zorder": 1}
                panel.hlines(place[str(category)], ends.min(), ends.max(), **look)
    is_spread = not chart.join and part[y.name].nunique() < len(part)
    for order, (series, style) in enumerate(styles.items()):
        points = part[part[chart.series].astype(str) == series] if chart.series else part
        shift = -0.75 * (order - (len(styles) - 1) / 2) / max(len(styles), 2) if is_spread else 0.0
        rows = np.array([place[str(v)] for v in points[y.name]]) + shift
        _draw_values(chart, panel, points, x, log, rows, style, style.marker or "o", 3)
    panel.grid(axis="y", color="#e4e4e4", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.set_xlabel(plain(x.heading))
    _scale_values(chart, panel, "x", x, values)


def _draw_grid(
    chart: Chart, panel: Axes, part: pd.DataFrame, styles: dict[str, Style], place: dict[str, int], width: float
) -> None:
    """Draw a cell per pair of x and y, coloured by level, in ``width`` inches."""
    x, y = chart.x[0], chart.y[0]
    names = _categories(x, part if chart.own_scales else chart.frame)
    room = width / max(len(names), 1)
    widest = max(map(width_in_inches, map(str, chart.frame[chart.cell])), default=0.0) if chart.cell else 0.0
    has_text = chart.cell and min(0.8 * 72 * room, SIZE * 0.92 * room / max(widest, 0.1)) >= SIZE - 1
    for line in part.to_dict("records"):
        at = names.index(_category(line[x.name])), place[_category(line[y.name])]
        face = styles[str(line[chart.level])].colour
        panel.add_patch(Rectangle((at[0] - 0.5, at[1] - 0.5), 1, 1, facecolor=face, edgecolor="white", linewidth=0.8))
        if has_text:  # smaller ones would not be readable
            text = plain(str(line[chart.cell]))
            panel.text(*at, text, ha="center", va="center", color=ink_on(face), fontsize=SIZE - 1)
    if chart.limit:
        heights = pd.Series(
            {value: place[_category(value)] for value in sorted(part[y.name].dropna().unique())}, dtype=float
        )
        ends = part.groupby(x.name)[chart.limit].first()
        ends = ends[(ends > 0) & np.isfinite(ends)]
        if len(heights) > 1 and len(ends):
            slope = (len(heights) - 1) / math.log(heights.index[-1] / heights.index[0])
            panel.plot(
                [names.index(_category(at)) for at in ends.index], np.log(ends / heights.index[0]) * slope, **LIMIT
            )
    panel.set_xlim(-0.5, len(names) - 0.5)
    labels, step, angle = [_wrapped(name, room - 0.06, r"_,\[ =") for name in names], 1, 0
    widest = max(map(_text_width, labels))
    if x.kind == "number":  # of numbers that would overlap, each second or more is shown
        step = math.ceil((widest + 0.08) / room)
    elif widest > room:
        angle = 90
        every = ([_wrapped(name, length) for name in names] for length in UPWARDS)
        labels = next((each for each in every if max(label.count("\n") + 1 for label in each) * LINE <= room), labels)
    panel.set_xticks(range(0, len(names), step), labels[::step], rotation=angle)
    panel.set_xlabel(plain(x.heading) if x.label or x.kind == "number" else "")
    panel.tick_params(length=0)
    for spine in panel.spines.values():
        spine.set_visible(False)


def _category(value: Any) -> str:
    return axis_value(float(value)) if isinstance(value, int | float | np.number) else str(value)


def _categories(column: Column, rows: pd.DataFrame, downwards: bool = False) -> list[str]:
    """Return the categories of an axis in order: strings as they appear, numbers increasing, or downwards decreasing."""
    values = rows[column.name].drop_duplicates()
    if pd.api.types.is_numeric_dtype(values):
        return list(dict.fromkeys(map(_category, sorted(values.dropna(), reverse=downwards))))
    return list(map(str, values))


def ink_on(ground: str) -> str:
    """Return black or white, whichever contrasts more with a colour."""
    r, g, b = to_rgb(ground)
    return "#000000" if 0.3 * r + 0.59 * g + 0.11 * b > 0.5 else "#ffffff"
