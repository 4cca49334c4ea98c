"""Draws charts, given as data, with Matplotlib.

No text is cut: a long one breaks into lines, and what it names gets higher.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle
from matplotlib.ticker import FixedLocator
from matplotlib.transforms import ScaledTranslation

from bench.experiment.columns import Column
from bench.experiment.views import Chart, Style
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
SIGNS = dict(zip(MARKERS, "●■◆▲▼✚✖★", strict=True))
"""The letter that looks like each marker, before the number of a value beyond the axis."""
HOLLOW: dict[str, Any] = {"markerfacecolor": "none"}
NEAR = 20.0
"""Distance from which an arrow joins two points, in hundredths of an inch."""
LIMIT: dict[str, Any] = {"color": "#000000", "linewidth": 1.4}
"""Look of a limit across a grid."""
MANY = 12
"""Most points of a line that are drawn with markers; longer lines are drawn without."""


def draw(chart: Chart, is_narrow: bool = False) -> Figure:
    """Return the chart as a figure, two columns of a paper wide, or one for plots without panels side by side.

    If ``is_narrow`` it is one column wide, with one panel across. Names are shortened: see :mod:`bench.report.names`.
    """
    chart = in_words(chart)
    parts = [(str(name), part) for name, part in chart.frame.groupby(chart.panel, sort=False)] if chart.panel else []
    parts = parts or [("", chart.frame)]
    is_plot = chart.kind in ("lines", "points")
    # quantities of the same runs above each other have one scale of x, so that their features can be compared
    stacked = chart.own_scales and is_plot
    panels = [(name, part, y) for y in chart.y[: len(chart.y) if stacked else 1] for name, part in parts]
    most = 1 if is_narrow or not chart.panel else chart.across
    width = NARROW if is_narrow or (is_plot and (len(parts) == 1 or not chart.panel)) else WIDTH
    down = math.ceil(len(panels) / max(1, min(most, len(parts))))
    across = math.ceil(len(panels) / down)
    is_keyed = chart.kind != "dots" or chart.series != chart.y[0].name  # else each row has its name
    styles = {
        name: replace(style, meaning=(style.meaning or name) * is_keyed)
        for name, style in looks_by_name([chart]).items()
    }

    rows = [[] if is_plot else _categories(y, part, downwards=True) for _, part, y in panels]
    # panels with the same rows have labels once, at the left
    shared = not chart.own_scales if is_plot else all(names == rows[0] for names in rows)
    beside = 1 if shared else across
    room = (0.46 if shared else 0.42 / across) * width
    labels = [[_wrapped(name, room) for name in names] for names in rows]
    written = [text for names in labels for text in names]
    inner = (width - beside * (0.85 if is_plot else max(map(_text_width, written), default=0.0))) / across - 0.12
    is_spread = chart.kind == "dots" and not chart.join and chart.series not in ("", chart.y[0].name)
    row = max([ROW, DOT * len(styles) * is_spread, *(LINE * (1 + text.count("\n")) + 0.015 for text in written)])
    heights = [
        (chart.height if is_plot else row * len(names) + 0.1) * (1.0 if y is chart.y[0] else BELOW)
        for names, (*_, y) in zip(rows, panels, strict=True)
    ]
    ratios = [max(heights[i * across : (i + 1) * across]) for i in range(down)]
    engine = ConstrainedLayoutEngine(w_pad=0.04, h_pad=PAD, rect=(0.006, 0, 0.988, 1))
    figure = Figure(figsize=(width, 4 + 2 * sum(ratios)), layout=engine)
    FigureCanvasAgg(figure)
    grid = figure.subplots(
        down,
        across,
        squeeze=False,
        sharey=is_plot and (shared or (chart.across > 1 and "row")),
        height_ratios=ratios,
        sharex=stacked or (not chart.own_scales and chart.kind == "dots"),
    ).ravel()
    for spare in grid[len(panels) :]:
        spare.remove()
    for place, (panel, (name, part, y), names) in enumerate(zip(grid, panels, rows, strict=False)):
        is_left, is_last = place % across == 0 or not shared, place + across >= len(panels)
        if is_plot:
            scaled = part if stacked and chart.across == 1 else chart.frame
            _draw_lines(chart, panel, part, styles, y, _is_log(y, scaled[y.name]))
            few = all(p[chart.x[0].name].nunique() <= 6 for _, p in parts)
            _scale(chart, panel, "x", chart.x[0], chart.frame if stacked else part, few)
            _scale(chart, panel, "y", y, scaled)
            if y is not chart.y[0]:
                panel.margins(y=0.4)
            elif chart.arrow:
                _draw_arrows(chart, panel, part, styles)
            panel.set_xlabel("" if stacked and not is_last else _wrapped(chart.x[0].heading, inner))
            panel.set_ylabel(_wrapped(y.heading, heights[place]) if place % across == 0 else "")
        else:
            panel.set_yticks(range(len(names)), labels[place][::-1])
            panel.set_ylim(-0.5, len(names) - 0.5)
            panel.tick_params(axis="y", length=0, labelleft=is_left)
            is_named = is_left and (y.label or y.kind == "number")
            panel.set_ylabel(_wrapped(y.heading, heights[place]) if is_named else "")
            cells = {label: len(names) - 1 - i for i, label in enumerate(names)}
            if chart.kind == "dots":
                _draw_dots(chart, panel, part, styles, cells)
            else:
                _draw_grid(chart, panel, part, styles, cells, inner)
            panel.tick_params(labelbottom=is_last or chart.own_scales)
            if not is_last and not chart.own_scales:
                panel.set_xlabel("")
        _draw_marks(chart, panel, name)
        is_first = y is chart.y[0]
        is_named = (len(parts) > 1 or not chart.subtitle.startswith(name)) and (is_first or across == 1)
        texts = name * is_named, chart.panel_notes.get(name, "") if is_first else y.doc
        title = [_wrapped(text, inner) for text in texts if text]
        # values beyond the panel are written between it and its title
        cuts = sum(text.get_gid() == "cut" for text in panel.texts)
        panel.set_title("\n".join(title), loc="left", fontsize=SIZE, pad=4 + CUT * cuts)
    _frame(figure, chart, [style.meaning for style in styles.values()])
    engine.execute(figure)
    drawn = figure.get_figheight() * sum(panel.get_position().height for panel in grid[::across])
    figure.set_figheight(figure.get_figheight() + sum(ratios) - drawn)
    figure.texts[0].set_y(1 - PAD / figure.get_figheight())
    return figure


# ------------------------------------------------------------------------------------- title, legend and texts


def _frame(figure: Figure, chart: Chart, first: Sequence[str]) -> None:
    """Write title and subtitle above the panels, and below them the legend: what they have drawn under a name, ``first`` series."""
    width = figure.get_figwidth()
    title = _wrapped(chart.title.rstrip("."), 0.97 * width / BOLD)
    subtitle = _wrapped(chart.subtitle.rstrip("."), 0.97 * width)
    look: dict[str, Any] = {"x": 0.06 / width, "ha": "left", "va": "top"}
    figure.text(y=1, s=title, fontsize=SIZE + 1, fontweight="bold", **look)
    # blank lines leave the place of the title
    below = "\n".join([" "] * (title.count("\n") + 1) + [subtitle] * bool(subtitle))
    figure.suptitle(below, fontsize=SIZE, color=GREY, linespacing=1.35, **look)
    drawn = {
        name: handle for panel in figure.axes for handle, name in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    names = [name for name in dict.fromkeys([*map(plain, first), *drawn]) if name in drawn]
    if drawn:
        labels = [_wrapped(name, width - 0.6) for name in names]
        figure.legend(
            [drawn[name] for name in names],
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


def _name(panel: Axes, name: str, **look: Any) -> None:
    """Name a kind of mark in the legend, beside an example of it."""
    panel.plot([], [], **{"color": GREY, "linestyle": "none", "label": plain(name)} | look)


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


def _is_log(column: Column, values: Any) -> bool:
    values = np.asarray(values, dtype=float)
    if column.log is None:
        return is_logarithmic(values)
    return column.log and bool((np.isfinite(values) & (values > 0)).any())


def _scale(
    chart: Chart, panel: Axes, which: Literal["x", "y"], column: Column, rows: pd.DataFrame, few: bool | None = None
) -> None:
    """Set the scale of an axis by its values in ``rows``, with a label at each if they are ``few``; None: what is drawn.

    Marks among the drawn values are in view, and the area above 1 is shaded where that means something.
    """
    axis, values = getattr(panel, f"{which}axis"), rows[column.name]
    if not pd.api.types.is_numeric_dtype(values):
        axis.set_tick_params(rotation=30)
        return
    places = np.unique(values[np.isfinite(values)])
    if _is_log(column, values) and (few is None or (places > 0).all()):
        low, high = _log_range(column, rows, [mark.at for mark in chart.marks if mark.axis == which and few is None])
        log_axis(
            panel, which, low, high, places if few and column.format == "setting" else (), _values_text(column, 0.0)
        )
        if column.above_one and high > 1:
            (panel.axvspan if which == "x" else panel.axhspan)(1.0, high, zorder=0, label=column.above_one, **SHADE)
        return
    if few:
        axis.set_major_locator(FixedLocator(list(places)))
    if text := _values_text(column, np.abs(places).max(initial=0.0)):
        axis.set_major_formatter(lambda value, _: text(value))


def _log_range(column: Column, rows: pd.DataFrame, marks: Sequence[float] = ()) -> tuple[float, float]:
    """Return the range of a logarithmic axis: all positive values, and their intervals within a factor of 100."""
    values = rows[column.name].clip(column.least, USELESS if column.above_one else None).to_numpy(float)
    values = values[np.isfinite(values) & (values > 0)]
    if not values.size:
        return 0.1, 10.0
    low, high = float(values.min()), float(values.max())
    ends = rows[[name for name in (column.low, column.high) if name]].to_numpy(float).ravel()
    ends = ends[np.isfinite(ends) & (ends >= low / 100) & (ends <= (USELESS if column.above_one else high * 100))]
    every = [low, high, *ends, *(at for at in marks if at > 0)]
    margin = max((max(every) / min(every)) ** 0.08, 1.15)
    return min(every) / margin, max(every) * margin


def _draw_marks(chart: Chart, panel: Axes, name: str) -> None:
    """Draw the named values and ranges of the axes; values without a name are quiet lines, not to be taken for a series."""
    names = list(dict.fromkeys(mark.name for mark in chart.marks if mark.name and mark.to is None))
    for mark in (mark for mark in chart.marks if mark.panel in (None, name)):
        low, high = getattr(panel, f"get_{mark.axis}lim")()
        kind = "axv" if mark.axis == "x" else "axh"
        look: dict[str, Any] = {"label": plain(mark.name), "linewidth": 0.9, "color": "#c0c0c0"}
        if mark.name in names:
            look |= {"color": "#595959", "linestyle": MARKS[names.index(mark.name) % len(MARKS)]}
        if mark.to is None and low < mark.at < high:
            getattr(panel, f"{kind}line")(mark.at, zorder=1, **look)
        elif mark.to is not None and (start := max(mark.at, low)) < (end := min(mark.to, high)):
            getattr(panel, f"{kind}span")(start, end, zorder=0, label=look["label"], **BAND)
            getattr(panel, f"set_{mark.axis}lim")(low, high)  # the range reaches the end of the axis


# -------------------------------------------------------------------------------------------- lines and points


def _draw_lines(chart: Chart, panel: Axes, part: pd.DataFrame, styles: dict[str, Style], y: Column, log: bool) -> None:
    x = chart.x[0]
    keys = [key for key in dict.fromkeys((chart.series, chart.line)) if key]
    groups = [*part.groupby(keys, sort=False)] if keys else [(("",), part)]
    for order, (key, points) in enumerate(groups):
        style = styles[str(key[0]) if chart.series else ""]
        is_line, is_number = chart.kind == "lines", pd.api.types.is_numeric_dtype(points[x.name])
        points = points.sort_values(x.name, kind="stable") if is_line and is_number else points
        mark = style.marker if not is_line or len(points) <= MANY or style.line == "none" else ""
        # marks on top of each other are all seen
        shift = BESIDE * (order - (len(groups) - 1) / 2) * (is_line and not (chart.line or chart.band) and mark != "")
        _draw_values(chart, panel, points, y, log, points[x.name].to_numpy(), style, mark, shift)


def _draw_arrows(chart: Chart, panel: Axes, part: pd.DataFrame, styles: dict[str, Style]) -> None:
    """Join the points of each arrow that has two, where they are apart."""
    x, y = chart.x[0], chart.y[0]
    for _, points in part.groupby(chart.arrow, sort=False):
        ends = np.array([points[x.name], points[y.name].clip(y.least, USELESS)], dtype=float).T
        if np.ptp(panel.transData.transform(ends), axis=0).max() > NEAR:
            colour = styles[str(points[chart.series].iloc[0])].colour
            panel.annotate(
                "", ends[-1], ends[0], arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 1.6}, zorder=2
            )
            _name(panel, chart.arrow_name, marker="$\u2192$", markersize=10)


def _draw_values(
    chart: Chart,
    panel: Axes,
    points: pd.DataFrame,
    column: Column,
    log: bool,
    places: np.ndarray,
    style: Style,
    marker: str,
    shift: float = 0.0,
) -> None:
    """Draw the values of a column at ``places`` of the other axis, with intervals, ``shift`` points to the right.

    Limits are hollow, failures crosses at the edge, and so are arrows to values beyond it, to which lines lead.
    """
    values = points[column.name].to_numpy(float)
    limit, lost = (
        points[name].to_numpy(bool) if name else np.zeros(len(points), bool) for name in (column.limit, chart.failed)
    )
    most = USELESS if log and column.above_one else math.inf
    given, is_cut = values, values > most
    if log:  # what has no logarithm is an upper limit too, at the least value that has one
        every = chart.frame[column.name]
        limit = (limit | (values <= column.least)) & ~lost
        values = values.clip(column.least or every[every > 0].min())
    is_flat = chart.kind == "dots"
    aside = ScaledTranslation(shift / 72, 0.0, panel.figure.dpi_scale_trans)
    edge = panel.get_yaxis_transform() if is_flat else panel.get_xaxis_transform()
    look: dict[str, Any] = {"color": style.colour, "zorder": 3}

    def plot(at: Any, value: Any, **more: Any) -> None:
        (line,) = panel.plot(*((value, at) if is_flat else (at, value)), **look | more)
        line.set_transform(line.get_transform() + aside)

    is_hollow, size = limit & bool(marker), 2.55 + 1.5 * style.width
    plot(
        places,
        np.where(is_hollow | lost, math.nan, values),  # dots lead to a limit
        marker=marker,
        markevery=~is_cut,
        linestyle=style.line if chart.kind == "lines" else "none",
        linewidth=style.width,
        markersize=size,
        drawstyle="steps-post" if chart.steps else "default",
        label=plain(style.meaning),
    )
    if is_hollow.any():
        shown, leads = np.where(lost, math.nan, values), ":" if chart.kind == "lines" else "none"
        plot(places, shown, marker=marker, markevery=limit, linestyle=leads, linewidth=0.8, markersize=size, **HOLLOW)
        _name(panel, "upper limit", marker="o", **HOLLOW)
    if column.low and column.high:
        low, high = (points[end].to_numpy(float) for end in (column.low, column.high))
        if log:
            low, high = np.maximum(low, SMALLEST), np.minimum(high, LARGEST)
        known = np.isfinite(low + high) & ~limit
        if known.any():
            mark = "s" if chart.band else "_" if is_flat else "|"
            key, alpha = GREY if chart.series else style.colour, 0.3 if chart.band else 1.0
            _name(panel, column.ends, marker=mark, markersize=9, color=key, alpha=alpha)
        if chart.band:
            panel.fill_between(places, low, high, known, color=style.colour, alpha=0.18, linewidth=0, zorder=2)
        else:
            bars = panel.hlines if is_flat else panel.vlines
            ends = bars(places[known], low[known], high[known], linewidth=1.0, **look)
            ends.set_transform(ends.get_transform() + aside)
    if is_cut.any():  # numbers are beside the panel, above those that were cut before
        arrow: dict[str, Any] = {"marker": f"${'→' if is_flat else '↑'}$", "markersize": 7}
        _name(panel, "beyond the axis, the largest as a number", **arrow)
        plot(places[is_cut], np.full(is_cut.sum(), 0.96), linestyle="none", transform=edge, **arrow)
        last = int(np.nanargmax(np.where(is_cut, given, np.nan)))
        cuts = [text.get_text().split()[-1] for text in panel.texts if text.get_gid() == "cut"]
        label = number(given[last])
        at, above = ((1, places[last]), (2, -3)) if is_flat else ((places[last], 1), (0, 2 + CUT * len(cuts)))
        if label not in cuts:
            panel.annotate(
                f"{SIGNS.get(marker, '')} {label}",
                at,
                above,
                xycoords=edge,
                textcoords="offset points",
                color=style.colour,
                gid="cut",
                ha="left" if is_flat else "center",
                annotation_clip=False,
            )
    if lost.any():
        _name(panel, chart.failed_name, marker="x")
        plot(
            places[lost],
            (given[lost] != 0) * (1.0 if is_flat else 0.97),
            marker="x",
            linestyle="none",
            transform=edge,
            markersize=5,
            markeredgewidth=1.4,
            clip_on=False,
        )


# ----------------------------------------------------------------------------------------------- dots and grids


def _draw_dots(chart: Chart, panel: Axes, part: pd.DataFrame, styles: dict[str, Style], place: dict[str, int]) -> None:
    """Draw a row per category, with a dot and an interval per series."""
    x, y = chart.x[0], chart.y[0]
    values = part if chart.own_scales else chart.frame
    log = _is_log(x, values[x.name])
    if chart.join:
        for category, points in part.groupby(part[y.name].astype(str), sort=False):
            ends = points[x.name].clip(x.least)
            ground = styles[str(points[chart.series].iloc[-1])].colour
            panel.hlines(place[str(category)], ends.min(), ends.max(), ground, zorder=1, alpha=0.45, linewidth=1.8)
    is_spread = not chart.join and part[y.name].nunique() < len(part)
    for order, (series, style) in enumerate(styles.items()):
        points = part[part[chart.series].astype(str) == series] if chart.series else part
        shift = -0.75 * (order - (len(styles) - 1) / 2) / max(len(styles), 2) if is_spread else 0.0
        rows = np.array([place[str(v)] for v in points[y.name]]) + shift
        _draw_values(chart, panel, points, x, log, rows, style, style.marker or "o")
    panel.grid(axis="y", color="#e4e4e4", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.set_xlabel(plain(x.heading))
    _scale(chart, panel, "x", x, values)


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
        at = names.index(value_text(line[x.name])), place[value_text(line[y.name])]
        face, name = styles[str(line[chart.level])].colour, plain(styles[str(line[chart.level])].meaning)
        panel.add_patch(
            Rectangle((at[0] - 0.5, at[1] - 0.5), 1, 1, facecolor=face, edgecolor="white", linewidth=0.8, label=name)
        )
        if has_text:  # smaller ones would not be readable
            text = plain(str(line[chart.cell]))
            panel.text(*at, text, ha="center", va="center", color=ink_on(face), fontsize=SIZE - 1)
    if len(part[[x.name, y.name]].drop_duplicates()) < len(names) * len(place):
        _name(panel, f"blank: {chart.failed_name}", marker="s", **HOLLOW)
    ends = part.groupby(x.name)[chart.limit].first() if chart.limit else pd.Series(dtype=float)
    levels = part[y.name].drop_duplicates()
    steps = [(levels <= end).sum() - 0.5 if 0 < end < math.inf else math.nan for end in ends]
    if np.isfinite(steps).any():  # along the edges of cells, since it crosses no number there
        panel.stairs(steps, np.arange(len(steps) + 1) - 0.5, baseline=None, label=chart.limit_name, **LIMIT)
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


def _categories(column: Column, rows: pd.DataFrame, downwards: bool = False) -> list[str]:
    """Return the categories of an axis in order: strings as they appear, numbers increasing, or downwards decreasing."""
    values = rows[column.name].drop_duplicates()
    if pd.api.types.is_numeric_dtype(values):
        values = values.dropna().sort_values(ascending=not downwards)
    return list(dict.fromkeys(map(value_text, values)))


def ink_on(ground: str) -> str:
    """Return black or white, whichever contrasts more with a colour."""
    r, g, b = to_rgb(ground)
    return "#000000" if 0.3 * r + 0.59 * g + 0.11 * b > 0.5 else "#ffffff"
