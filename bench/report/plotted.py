"""Reads the plotted data back from a figure as a table: the exact values, even where points are shifted on paper."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.report.scales import in_data

COLUMNS = [
    "panel",
    "title",
    "x_label",
    "y_label",
    "series",
    "mark",
    "x",
    "y",
    "x_low",
    "x_high",
    "y_low",
    "y_high",
    "text",
]
HOLLOW = "#ffffff"
"""Face colour of markers at upper limits."""
SIGNS: dict[Any, str] = {"|": "tick", "x": "cross"}


def plotted(figure: Figure) -> pd.DataFrame:
    """Return a table with a line per point of a figure and its interval, per corner of a band, and per text in the data.

    The column ``mark`` is ``point``, ``limit`` (an upper limit), ``tick``, ``cross``, ``line`` (a corner of a line
    without markers), ``band`` or ``text``.
    """
    rows = []
    for number, axes in enumerate(figure.axes):
        common = {"panel": number, "title": _title(axes), "x_label": axes.get_xlabel(), "y_label": _y_label(axes)}
        rows += [common | row for row in (*_points(axes), *_bands(axes), *_texts(axes))]
    return pd.DataFrame(rows, columns=COLUMNS)


def _points(axes: Axes) -> Iterator[dict[str, Any]]:
    """Yield the points of all lines with their series.

    An unlabelled line belongs to the last labelled line of its colour drawn before it, or else to the first one.
    """
    bars = _intervals(axes)
    drawn = [line for line in axes.lines if in_data(axes, line)]
    named = {line: label for line in drawn if (label := _label(axes, line))}
    labels = {to_hex(line.get_color()): label for line, label in reversed(named.items())}
    seen: dict[tuple[str, int, float, float], dict[str, Any]] = {}
    for line in drawn:
        colour = to_hex(line.get_color())
        labels[colour] = named.get(line, labels.get(colour, ""))
        series = labels[colour]
        for x, y in np.asarray(line.get_xydata(), dtype=float):
            if not np.isfinite([x, y]).all():
                continue
            row = {"series": series, "mark": _mark(line), "x": x, "y": y}
            point = seen.setdefault((series, _place(line), x, y), row)
            if point["mark"] == "line":
                point["mark"] = row["mark"]
            point |= bars.get((colour, _place(line), x, y), {})
    yield from seen.values()


def _place(line: Line2D) -> int:
    """Return the id of a line's transform, which distinguishes lines that are shifted sideways on paper."""
    return id(line.get_transform())


def _label(axes: Axes, line: Line2D) -> str:
    """Return the label of a line, or of the error bars that it belongs to; empty if there is none."""
    owners = [c for c in axes.containers if isinstance(c, ErrorbarContainer) and c.lines[0] is line]
    texts = [str(line.get_label()), *(str(owner.get_label()) for owner in owners)]
    return next((text for text in texts if not text.startswith("_") and text != "None"), "")


def _mark(line: Line2D) -> str:
    if line.get_marker() in ("", "None", None):
        return "line"
    if line.get_marker() in SIGNS:
        return SIGNS[line.get_marker()]
    face = line.get_markerfacecolor()
    return "limit" if face not in ("none", "auto") and to_hex(face) == HOLLOW else "point"


def _intervals(axes: Axes) -> dict[tuple[str, int, float, float], dict[str, float]]:
    """Return the ends of error bars by the colour, transform, x and y of their points."""
    intervals: dict[tuple[str, int, float, float], dict[str, float]] = {}
    for container in axes.containers:
        if not isinstance(container, ErrorbarContainer) or container.lines[0] is None:
            continue
        line, _, bars = container.lines
        points = np.asarray(line.get_xydata(), dtype=float)
        kinds = [name for name, drawn in (("x", container.has_xerr), ("y", container.has_yerr)) if drawn]
        for kind, collection in zip(kinds, bars, strict=True):
            assert isinstance(collection, LineCollection)
            for (x, y), segment in zip(points, collection.get_segments(), strict=False):
                ends = np.asarray(segment)[:, 0 if kind == "x" else 1]
                place = intervals.setdefault((to_hex(line.get_color()), _place(line), x, y), {})
                place |= {f"{kind}_low": float(ends.min()), f"{kind}_high": float(ends.max())}
    return intervals


def _bands(axes: Axes) -> Iterator[dict[str, Any]]:
    """Yield the corners of filled areas between curves."""
    for area in axes.collections:
        if isinstance(area, PolyCollection) and area.get_transform().contains_branch(axes.transData):
            for path in area.get_paths():
                for x, y in np.asarray(path.vertices):
                    yield {"series": str(area.get_label()).removeprefix("_"), "mark": "band", "x": x, "y": y}


def _texts(axes: Axes) -> Iterator[dict[str, Any]]:
    """Yield texts positioned in data coordinates, such as the letters of a map."""
    for text in axes.texts:
        if text.get_transform() == axes.transData and text.get_text():
            x, y = text.get_position()
            yield {"series": "", "mark": "text", "x": x, "y": y, "text": text.get_text()}


def _title(axes: Axes) -> str:
    """Return the panel's title, or else the title of the nearest titled panel above it."""
    return " ".join(_nearest(axes, "title").split())


def _y_label(axes: Axes) -> str:
    """Return the label of the panel's y axis, or else of the nearest labelled panel to its left."""
    return re.sub(r"\s+", " ", _nearest(axes, "label"))


def _nearest(axes: Axes, what: str) -> str:
    def text(one: Axes) -> str:
        return one.get_title() if what == "title" else one.get_ylabel()

    spec = axes.get_subplotspec()
    if text(axes) or spec is None or axes.figure is None:
        return text(axes)
    candidates = []
    for other in axes.figure.axes:
        place = other.get_subplotspec()
        if place is None or place.get_gridspec() is not spec.get_gridspec() or not text(other):
            continue
        down = spec.rowspan.start - place.rowspan.start
        across = spec.colspan.start - place.colspan.start
        apart, aside = (down, across) if what == "title" else (across, down)
        if apart > 0 and aside == 0:
            candidates.append((apart, text(other)))
    return min(candidates)[1] if candidates else ""
