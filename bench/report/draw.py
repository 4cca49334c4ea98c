"""Draws charts, given as data, with Matplotlib.

No text is cut: a long one breaks into lines, and what it names gets higher.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle
from matplotlib.ticker import FixedLocator
from matplotlib.transforms import offset_copy

from bench.experiment.columns import Column
from bench.experiment.views import Chart, Mark, Style
from bench.report.colours import looks_by_name
from bench.report.names import in_words
from bench.report.problems import value_text
from bench.report.scales import LARGEST, SMALLEST, log_axis
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
ROW = 0.22
"""Least height of a row of dots or cells in inches."""
DOT = 0.075
"""Height in inches of a series in a row of dots."""
BELOW = 0.35
"""Height of further quantities below the first, relative to its height."""
BAND: dict[str, Any] = {"color": "#D55E00", "alpha": 0.12, "linewidth": 0}
"""Look of a named range of an axis."""
USELESS = 1e2
"""Where a value above 1 means a failure, larger values are drawn here with their number."""
CUT = SIZE + 1
"""Height of the line of such a number, in points."""
BESIDE = 2.5
"""Distance in points of the marks of a panel's lines at the same place."""
LETTERS = dict(zip(MARKERS, "●■◆▲▼✚✖★", strict=True))
"""The letter that looks like each marker, before the number of a value beyond the axis."""
HOLLOW: dict[str, Any] = {"markerfacecolor": "none"}
NEAR = 20.0
"""Distance from which an arrow joins two points, in hundredths of an inch."""
LIMIT: dict[str, Any] = {"color": "#000000", "linewidth": 1.4}
"""Look of a limit across a grid."""
MANY = 12
"""Most points of a line that are drawn with markers; longer lines are drawn without."""

Drawn = Sequence[tuple[Chart, Sequence[Figure]]]
"""Charts, each with its figures: the wide one, and a narrow one if that differs."""


def draw(chart: Chart, is_narrow: bool = False) -> Figure:
    """Return the chart as a figure, two columns of a paper wide, or one for plots without panels side by side.

    If ``is_narrow`` it is one column wide, with one panel across. Names are shortened: see :mod:`bench.report.names`.
    """
    chart = in_words(chart)
    # a column that the chart does not name is the one without a name, which is empty
    layout = _layout(_panels(replace(chart, frame=chart.frame.assign(**{"": ""}))), is_narrow)
    engine = ConstrainedLayoutEngine(w_pad=0.04, h_pad=PAD, rect=(0.006, 0, 0.988, 1))
    figure = Figure(figsize=(layout.width, 4 + 2 * sum(layout.ratios)), layout=engine)
    FigureCanvasAgg(figure)
    first = layout.panels[0]
    grid = figure.subplots(
        len(layout.ratios),
        layout.across,
        squeeze=False,
        sharex=first.has_common_x,
        sharey=first.is_plot and ("row" if chart.own_scales else "all"),
        height_ratios=layout.ratios,
    ).ravel()
    for spare in grid[len(layout.panels) :]:
        spare.remove()
    for place in range(len(layout.panels)):
        _draw_panel(grid[place], layout, place)
    _frame(figure, chart, [plain(style.meaning) for style in first.styles.values()])
    engine.execute(figure)
    drawn = figure.get_figheight() * sum(axes.get_position().height for axes in grid[:: layout.across])
    figure.set_figheight(figure.get_figheight() + sum(layout.ratios) - drawn)
    figure.texts[0].set_y(1 - PAD / figure.get_figheight())
    return figure


# ------------------------------------------------------------------------------------------------------ layout


@dataclass(frozen=True)
class Panel:
    """What a panel shows: the rows with one value of the column ``chart.panel``, and one quantity y."""

    chart: Chart
    styles: Mapping[str, Style]
    name: str
    rows: pd.DataFrame
    x: Column
    y: Column
    is_plot: bool
    """Whether it has points at numbers of y; else it has a row per category of y."""
    is_first: bool
    """Whether y is the first quantity of the chart."""
    has_common_x: bool
    """Whether all panels have one scale of x, so that features of quantities above each other can be compared."""
    categories: Sequence[str]
    """The names of its rows of dots or cells, from the top."""
    value: Column
    """The measured quantity: y of a plot, x of dots."""
    scaled: pd.DataFrame
    """The rows that decide the scale of the measured quantity."""

    def heights(self, rows: pd.DataFrame) -> np.ndarray:
        """Return the height of the category of each row, from 0 for the lowest."""
        return pd.Categorical(rows[self.y.name].map(value_text), self.categories[::-1]).codes


@dataclass(frozen=True)
class Layout:
    """The panels of a chart, row by row, with the names of their rows in lines, and their sizes in inches."""

    panels: Sequence[Panel]
    across: int
    width: float
    inner: float
    """The width of a panel without the labels of its y axis."""
    heights: Sequence[float]
    labels: Sequence[Sequence[str]]
    is_shared: bool
    """Whether panels beside each other have the same scale or rows, with labels once, at the left."""

    ratios: Sequence[float]
    """The height of each row of panels."""


def _panels(chart: Chart) -> list[Panel]:
    """Return a panel per part of a chart; of plots with their own scales there are as many for each quantity."""
    is_named = chart.kind != "dots" or chart.series != chart.y[0].name  # else each row has its name
    styles = {
        name: replace(
            style,
            line=style.line if chart.kind == "lines" else "none",
            meaning=(style.meaning or name) * is_named,
        )
        for name, style in looks_by_name([chart]).items()
    }
    is_plot, has_own, x = chart.kind in ("lines", "points"), chart.own_scales, chart.x[0]
    parts = [*chart.frame.groupby(chart.panel, sort=False)] or [("", chart.frame)]
    return [
        Panel(
            chart,
            styles,
            str(name),
            rows,
            x,
            y,
            is_plot,
            y is chart.y[0],
            has_own == is_plot,
            [] if is_plot else _categories(y, rows, downwards=True),
            y if is_plot else x,
            rows if has_own and (not is_plot or chart.across == 1) else chart.frame,
        )
        for y in chart.y[: None if is_plot and has_own else 1]
        for name, rows in parts
    ]


def _layout(panels: Sequence[Panel], is_narrow: bool) -> Layout:
    first, parts = panels[0], sum(panel.is_first for panel in panels)
    down = math.ceil(len(panels) / min(1 if is_narrow else first.chart.across, parts))
    across = math.ceil(len(panels) / down)
    width = NARROW if is_narrow or (first.is_plot and parts == 1) else WIDTH
    is_shared = all(p.categories == first.categories for p in panels) and not (first.is_plot and first.chart.own_scales)
    beside, share = (1, 0.46) if is_shared else (across, 0.42)
    labels = [[_wrapped(name, share / beside * width) for name in panel.categories] for panel in panels]
    widest = max(map(_text_width, chain(*labels)), default=0.85)
    inner = (width - beside * widest) / across - 0.12
    heights = _heights(panels, [*chain(*labels)])
    ratios = [max(heights[i : i + across]) for i in range(0, len(panels), across)]
    return Layout(panels, across, width, inner, heights, labels, is_shared, ratios)


def _heights(panels: Sequence[Panel], labels: Sequence[str]) -> list[float]:
    """Return the height of each panel."""
    chart = panels[0].chart
    is_spread = chart.kind == "dots" and not chart.join and chart.series != chart.y[0].name
    row = max(
        [ROW, DOT * len(panels[0].styles) * is_spread, *(LINE * (1 + text.count("\n")) + 0.015 for text in labels)]
    )
    return [
        (chart.height if panel.is_plot else row * len(panel.categories) + 0.1) * (1.0 if panel.is_first else BELOW)
        for panel in panels
    ]


def _draw_panel(axes: Axes, layout: Layout, place: int) -> None:
    panel, labels = layout.panels[place], layout.labels[place][::-1]
    chart, y = panel.chart, panel.y
    is_left = place % layout.across == 0 or not (panel.is_plot or layout.is_shared)
    is_lowest = place + layout.across >= len(layout.panels) or not panel.has_common_x
    if labels:
        axes.set_yticks(range(len(labels)), labels)
        axes.set_ylim(-0.5, len(labels) - 0.5)
        axes.tick_params(axis="y", length=0, labelleft=is_left)
    DRAWN[chart.kind](axes, panel, layout.inner)
    _draw_marks(axes, panel)
    axes.tick_params(labelbottom=is_lowest)
    axes.set_xlabel(_heading(panel.x, layout.inner) * is_lowest)
    axes.set_ylabel(_heading(y, layout.heights[place]) * is_left)
    is_only = len(panel.rows) == len(chart.frame) and chart.subtitle.startswith(panel.name)
    name = panel.name * (not is_only and (panel.is_first or layout.across == 1))
    note = chart.panel_notes.get(panel.name, "") if panel.is_first else y.doc
    title = "\n".join(_wrapped(text, layout.inner) for text in (name, note) if text)
    # values beyond the panel are written between it and its title
    axes.set_title(title, loc="left", fontsize=SIZE, pad=4 + CUT * len(_cuts(axes)))


# ------------------------------------------------------------------------------------- titles, legend and texts


def _heading(column: Column, width: float) -> str:
    """Return the heading of a column in lines; that of categories only if it is given."""
    return _wrapped(column.heading, width) if column.label or column.kind == "number" else ""


def _frame(figure: Figure, chart: Chart, first: Sequence[str]) -> None:
    """Write title and subtitle above the panels, and below them the legend: what they have drawn under a name, ``first`` series."""
    width = figure.get_figwidth()
    title = _wrapped(chart.title.rstrip("."), 0.97 * width / BOLD)
    subtitle = _wrapped(chart.subtitle.rstrip("."), 0.97 * width)
    look: dict[str, Any] = {"x": 0.06 / width, "ha": "left", "va": "top"}
    figure.text(y=1, s=title, fontsize=SIZE + 1, fontweight="bold", **look)
    # blank lines leave the place of the title
    below = (" \n" * (title.count("\n") + 1) + subtitle).rstrip("\n")
    figure.suptitle(below, fontsize=SIZE, color=GREY, linespacing=1.35, **look)
    drawn = {
        name: handle for axes in figure.axes for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if drawn:
        drawn = {name: drawn[name] for name in (*first, *drawn) if name in drawn}
        labels = [_wrapped(name, width - 0.6) for name in drawn]
        figure.legend(
            [*drawn.values()],
            labels,
            loc="outside lower center",
            ncols=_legend_columns(labels, width),
            frameon=False,
            fontsize=SIZE,
            columnspacing=1.2,
            handletextpad=0.5,
            labelspacing=0.25,
            borderaxespad=0.1,
        )


def _wrapped(text: str, width: float, ends: str = r" ,/\[") -> str:
    """Return text in lines of at most ``width`` inches, escaped for Matplotlib."""
    return "\n".join(map(plain, filled(text, width, ends).split("\n")))


def _text_width(text: str) -> float:
    return max(map(width_in_inches, text.split("\n")))


def _name(axes: Axes, name: str, **look: Any) -> None:
    """Name a kind of mark in the legend, beside an example of it."""
    axes.plot([], [], **{"color": GREY, "linestyle": "none", "label": plain(name)} | look)


def _legend_columns(labels: Sequence[str], width: float) -> int:
    lengths = np.array([0.5 + _text_width(label) for label in labels])
    counts = range(min(len(lengths), 8), 1, -1)
    return next((n for n in counts if sum(part.max() for part in np.array_split(lengths, n)) <= width), 1)


# ------------------------------------------------------------------------------------------------------ scales


def _values_text(column: Column, largest: float) -> Any:
    """Return the function that formats the numbers of an axis; None for plain numbers."""
    if column.format == "seconds":
        return short_duration
    if column.format == "percent":
        return lambda value: f"{100 * value:g}%"
    return axis_value if largest >= 1e5 else None


def _is_log(column: Column, values: pd.Series) -> bool:
    if column.log is None:
        return is_logarithmic(values)
    return column.log and bool(((values > 0) & (values < math.inf)).any())


def _scale(
    axes: Axes, which: str, column: Column, rows: pd.DataFrame, marks: Sequence[Mark] = (), ticks: Any = ()
) -> None:
    """Set the scale of an axis by the values in ``rows``, with ``marks`` in view and labels at ``ticks`` where these are given.

    The area above 1 is shaded where that means something.
    """
    axis, values = getattr(axes, f"{which}axis"), rows[column.name]
    if _is_log(column, values):
        low, high = _log_range(column, rows, [mark.at for mark in marks if mark.axis == which])
        log_axis(axes, which, low, high, ticks if column.format == "setting" else (), _values_text(column, 0.0))
        if column.above_one and high > 1:
            shade = axes.axvspan if which == "x" else axes.axhspan
            shade(1.0, high, zorder=0, label=column.above_one, **SHADE)
    else:
        if len(ticks):
            axis.set_major_locator(FixedLocator(ticks))
        if text := _values_text(column, values[np.isfinite(values)].abs().max()):
            axis.set_major_formatter(lambda value, _: text(value))


def _log_range(column: Column, rows: pd.DataFrame, marks: Sequence[float]) -> tuple[float, float]:
    """Return the range of a logarithmic axis: all positive values, and their intervals within a factor of 100."""
    values = rows[column.name].clip(column.least, USELESS if column.above_one else None)
    values = values[(values > 0) & (values < math.inf)]
    low, high = values.min(), values.max()
    ends = rows[[name for name in (column.low, column.high) if name]].to_numpy(float)
    ends = ends[(ends >= low / 100) & (ends <= (USELESS if column.above_one else high * 100))]
    every = [low, high, *ends, *(at for at in marks if at > 0)]
    margin = max((max(every) / min(every)) ** 0.08, 1.15)
    return min(every) / margin, max(every) * margin


def _draw_marks(axes: Axes, panel: Panel) -> None:
    """Draw the named values and ranges of the axes; values without a name are quiet lines, not to be taken for a series."""
    marks = panel.chart.marks
    names = dict.fromkeys(mark.name for mark in marks if mark.name and mark.to is None)
    dashes = dict(zip(names, MARKS * len(names), strict=False))
    for mark in marks:
        low, high = getattr(axes, f"get_{mark.axis}lim")()
        kind = "axv" if mark.axis == "x" else "axh"
        start, end = max(mark.at, low), min(mark.at if mark.to is None else mark.to, high)
        if mark.panel not in (None, panel.name) or start > end:
            continue
        if mark.to is not None:
            getattr(axes, f"{kind}span")(start, end, zorder=0, label=plain(mark.name), **BAND)
            getattr(axes, f"set_{mark.axis}lim")(low, high)  # the range reaches the end of the axis
        else:
            getattr(axes, f"{kind}line")(
                start,
                zorder=1,
                label=plain(mark.name),
                linewidth=0.9,
                color="#595959" if mark.name else "#c0c0c0",
                linestyle=dashes.get(mark.name, "-"),
            )


# -------------------------------------------------------------------------------------------- lines and points


def _draw_plot(axes: Axes, panel: Panel, _: float) -> None:
    """Draw points against x, joined by lines or arrows, and set the scales."""
    chart, x = panel.chart, panel.x.name
    is_numeric = pd.api.types.is_numeric_dtype(chart.frame[x])
    groups = panel.rows.groupby([*dict.fromkeys((chart.series, chart.line))], sort=False)
    for order, ((series, *_), rows) in enumerate(groups):
        if is_numeric:
            rows = rows.sort_values(x, kind="stable")
        style = panel.styles[str(series)]
        if len(rows) > MANY and style.line != "none":
            style = replace(style, marker="")
        # marks on top of each other are all seen
        is_aside = chart.kind == "lines" and not (chart.line or chart.band) and style.marker != ""
        shift = BESIDE * (order - (len(groups) - 1) / 2) * is_aside
        _draw_series(Series(axes, panel, style, rows[x].to_numpy(), shift), rows)
    if is_numeric:
        rows = chart.frame if chart.own_scales else panel.rows
        is_few = chart.frame.groupby(chart.panel)[x].nunique().max() <= 6
        _scale(axes, "x", panel.x, rows, ticks=np.unique(rows[x].dropna()) if is_few else ())
    else:
        axes.tick_params("x", rotation=30)
    _scale(axes, "y", panel.y, panel.scaled, chart.marks)
    if not panel.is_first:
        axes.margins(y=0.4)
    elif chart.arrow:
        _draw_arrows(axes, panel)


def _draw_arrows(axes: Axes, panel: Panel) -> None:
    """Join the points of each arrow that has two, where they are apart."""
    chart, y = panel.chart, panel.y
    for _, rows in panel.rows.groupby(chart.arrow, sort=False):
        ends = np.array([rows[panel.x.name], rows[y.name].clip(y.least, USELESS)], dtype=float).T
        if np.ptp(axes.transData.transform(ends), axis=0).max() > NEAR:
            colour = panel.styles[str(rows[chart.series].iloc[0])].colour
            look = {"arrowstyle": "-|>", "color": colour, "linewidth": 1.6}
            axes.annotate("", ends[-1], ends[0], arrowprops=look, zorder=2)
            _name(axes, chart.arrow_name, marker="$\u2192$", markersize=10)


# ------------------------------------------------------------------------------------------ values of a series


@dataclass(frozen=True)
class Series:
    """Points of one look in a panel, at ``places`` of the axis across their values, drawn ``shift`` points to the right."""

    axes: Axes
    panel: Panel
    style: Style
    places: np.ndarray
    shift: float = 0.0

    def plot(self, which: Any, values: Any, **look: Any) -> None:
        """Draw some of the points at ``values``."""
        pair = (self.places[which], values)[:: 1 if self.panel.is_plot else -1]
        (line,) = self.axes.plot(*pair, color=self.style.colour, zorder=3, **{"linestyle": "none"} | look)
        self.move(line)

    def move(self, drawn: Any) -> None:
        """Shift what was drawn."""
        drawn.set_transform(offset_copy(drawn.get_transform(), drawn.figure, self.shift, units="points"))


def _draw_series(series: Series, rows: pd.DataFrame) -> None:
    """Draw the measured values of rows with intervals.

    Limits are hollow, failures crosses at the edge, and so are arrows to values beyond it, to which lines lead.
    """
    column, chart, style = series.panel.value, series.panel.chart, series.style
    given = values = rows[column.name].to_numpy(float)
    is_failed, is_limit = (rows[name].to_numpy(bool) for name in (chart.failed, column.limit))
    low, high = (pd.to_numeric(rows[end], errors="coerce").to_numpy() for end in (column.low, column.high))
    most = math.inf
    if _is_log(column, series.panel.scaled[column.name]):
        every = chart.frame[column.name]  # what has no logarithm is an upper limit too, at the least value that has one
        values = given.clip(column.least or every[every > 0].min())
        is_limit = is_limit | (given <= column.least)
        low, high = np.maximum(low, SMALLEST), np.minimum(high, LARGEST)
        most = USELESS if column.above_one else most
    is_limit = is_limit & ~is_failed
    is_hollow, size = is_limit & bool(style.marker), 2.55 + 1.5 * style.width
    series.plot(
        slice(None),
        np.where(is_hollow | is_failed, math.nan, values),  # dots lead to a limit
        marker=style.marker,
        markevery=~(given > most),
        linestyle=style.line,
        linewidth=style.width,
        markersize=size,
        drawstyle="steps-post" if chart.steps else "default",
        label=plain(style.meaning),
    )
    if is_hollow.any():
        shown, leads = np.where(is_failed, math.nan, values), ":" if chart.kind == "lines" else "none"
        look = {"marker": style.marker, "markersize": size, "linestyle": leads, "linewidth": 0.8} | HOLLOW
        series.plot(slice(None), shown, markevery=is_limit, **look)
        _name(series.axes, "upper limit", marker="o", **HOLLOW)
    _draw_intervals(series, low, high, np.isfinite(low + high) & ~is_limit)
    _draw_at_edge(series, given, given > most, is_failed)


def _draw_intervals(series: Series, low: np.ndarray, high: np.ndarray, is_known: np.ndarray) -> None:
    """Draw the intervals that are known as bars, or as a band."""
    axes, panel, places, colour = series.axes, series.panel, series.places, series.style.colour
    if not is_known.any():
        return
    bars, mark = (axes.vlines, "|") if panel.is_plot else (axes.hlines, "_")
    mark, alpha = ("s", 0.3) if panel.chart.band else (mark, 1.0)
    key = GREY if panel.chart.series else colour
    _name(axes, panel.value.ends, marker=mark, markersize=9, color=key, alpha=alpha)
    if panel.chart.band:
        axes.fill_between(places, low, high, is_known, color=colour, alpha=0.18, linewidth=0, zorder=2)
    else:
        series.move(bars(places[is_known], low[is_known], high[is_known], linewidth=1.0, color=colour, zorder=3))


def _draw_at_edge(series: Series, given: np.ndarray, is_beyond: np.ndarray, is_failed: np.ndarray) -> None:
    """Draw arrows to values beyond the axis, with the largest beside the panel, and crosses for failures, at the lower edge for 0."""
    axes, is_plot = series.axes, series.panel.is_plot
    edge = axes.get_xaxis_transform() if is_plot else axes.get_yaxis_transform()
    if is_beyond.any():
        mark, cuts = "$↑$" if is_plot else "$→$", _cuts(axes)
        _name(axes, "beyond the axis, the largest as a number", marker=mark, markersize=7)
        series.plot(is_beyond, [0.96] * is_beyond.sum(), transform=edge, marker=mark, markersize=7)
        largest = np.argmax(np.where(is_beyond, given, 0.0))
        label, at = number(given[largest]), series.places[largest]
        if label not in cuts:
            axes.annotate(
                f"{LETTERS.get(series.style.marker, '')} {label}",
                (at, 1) if is_plot else (1, at),
                (0, 2 + CUT * len(cuts)) if is_plot else (2, -3),  # above those that are there
                xycoords=edge,
                textcoords="offset points",
                color=series.style.colour,
                gid="cut",
                ha="center" if is_plot else "left",
                annotation_clip=False,
            )
    if is_failed.any():
        _name(axes, series.panel.chart.failed_name, marker="x")
        at = (given[is_failed] != 0) * (0.97 if is_plot else 1.0)
        series.plot(is_failed, at, transform=edge, markersize=5, markeredgewidth=1.4, marker="x", clip_on=False)


def _cuts(axes: Axes) -> list[str]:
    """Return the numbers that stand beside a panel, since they are beyond its axis."""
    return [text.get_text().split()[-1] for text in axes.texts if text.get_gid() == "cut"]


# ----------------------------------------------------------------------------------------------- dots and grids


def _draw_dots(axes: Axes, panel: Panel, _: float) -> None:
    """Draw a row per category, with a dot and an interval per series."""
    chart, styles, x = panel.chart, panel.styles, panel.x
    for _, rows in panel.rows.groupby(panel.y.name, sort=False) if chart.join else ():
        ends, colour = rows[x.name].clip(x.least), styles[str(rows[chart.series].iloc[-1])].colour
        axes.hlines(panel.heights(rows)[0], ends.min(), ends.max(), colour, zorder=1, alpha=0.45, linewidth=1.8)
    is_spread = not chart.join and panel.rows[panel.y.name].nunique() < len(panel.rows)
    for order, (name, style) in enumerate(styles.items()):
        rows = panel.rows[panel.rows[chart.series].astype(str) == name]
        above = 0.75 * ((len(styles) - 1) / 2 - order) / max(len(styles), 2) * is_spread
        _draw_series(Series(axes, panel, replace(style, marker=style.marker or "o"), panel.heights(rows) + above), rows)
    axes.grid(axis="y", color="#e4e4e4", linewidth=0.6)
    axes.set_axisbelow(True)
    _scale(axes, "x", x, panel.scaled, chart.marks)


def _draw_grid(axes: Axes, panel: Panel, width: float) -> None:
    """Draw a cell per pair of x and y, coloured by level, in ``width`` inches."""
    chart, x, rows = panel.chart, panel.x, panel.rows
    names = _categories(x, chart.frame)
    room = width / len(names)
    widest = max(map(width_in_inches, map(str, chart.frame[chart.cell])))
    has_text = room >= 0.95 * max(widest, 0.128)  # smaller ones would not be readable
    for line, height in zip(rows.to_dict("records"), panel.heights(rows), strict=True):
        style, place = panel.styles[str(line[chart.level])], names.index(value_text(line[x.name]))
        name, corner = plain(style.meaning), (place - 0.5, height - 0.5)
        axes.add_patch(Rectangle(corner, 1, 1, facecolor=style.colour, edgecolor="white", linewidth=0.8, label=name))
        if has_text:
            text = plain(str(line[chart.cell]))
            axes.text(place, height, text, ha="center", va="center", color=ink_on(style.colour), fontsize=SIZE - 1)
    if len(rows.drop_duplicates([x.name, panel.y.name])) < len(names) * len(panel.categories):
        _name(axes, f"blank: {chart.failed_name}", marker="s", **HOLLOW)
    if chart.limit:  # along the edges of cells, since it crosses no number there
        levels, ends = rows[panel.y.name].drop_duplicates(), rows.groupby(x.name)[chart.limit].first()
        steps = [(levels <= end).sum() - 0.5 if 0 < end < math.inf else math.nan for end in ends]
        if np.isfinite(steps).any():
            axes.stairs(steps, np.arange(len(steps) + 1) - 0.5, baseline=None, label=chart.limit_name, **LIMIT)
    axes.set_xlim(-0.5, len(names) - 0.5)
    _name_columns(axes, x, names, room)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


def _name_columns(axes: Axes, x: Column, names: Sequence[str], room: float) -> None:
    """Write the names of columns ``room`` inches wide: of numbers that would overlap each second or more, long words upwards."""
    labels, step, angle = [_wrapped(name, room - 0.06, r"_,\[ =") for name in names], 1, 0
    widest = max(map(_text_width, labels))
    if x.kind == "number":
        step = math.ceil((widest + 0.08) / room)
    elif widest > room:
        angle = 90
        every = ([_wrapped(name, length) for name in names] for length in UPWARDS)
        labels = next((each for each in every if max(label.count("\n") + 1 for label in each) * LINE <= room), labels)
    axes.set_xticks(range(0, len(names), step), labels[::step], rotation=angle)


DRAWN = {"lines": _draw_plot, "points": _draw_plot, "dots": _draw_dots, "grid": _draw_grid}
"""What draws the inside of a panel, by kind of chart."""


def _categories(column: Column, rows: pd.DataFrame, downwards: bool = False) -> list[str]:
    """Return the categories of an axis in order: strings as they appear, numbers increasing, or downwards decreasing."""
    values = rows[column.name]
    if pd.api.types.is_numeric_dtype(values):
        values = values.dropna().sort_values(ascending=not downwards)
    return list(dict.fromkeys(map(value_text, values)))


def ink_on(ground: str) -> str:
    """Return black or white, whichever contrasts more with a colour."""
    return "#000000" if np.dot(to_rgb(ground), (0.3, 0.59, 0.11)) > 0.5 else "#ffffff"
