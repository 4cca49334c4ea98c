"""Draws error against time along a swept axis: one curve per estimator, its points labelled with the axis values.

The chart shows whether, for example, a stiffer contact or a longer horizon costs time, accuracy, or both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from bench.experiment.axes import Axis
from bench.report.page import columns, page, shared
from bench.report.problems import ProblemRows
from bench.report.scales import log_axis
from bench.report.style import SHADE, Styles, axis_name, plain
from bench.report.text import axis_value, number
from bench.report.views import CATEGORIES, Curve, estimator_curves
from bench.studies.bias_variance.costs import TIME
from bench.studies.bias_variance.findings import winners

FEWEST = 3
"""Fewest values of an axis for which the chart is drawn."""
APART = 0.075, 0.06
"""Distance, as a share of a panel's width and height, within which neighbouring points of a curve share a label."""
LETTER = 0.0115, 0.05
"""Width of a character and height of a line of labels, as a share of a panel's width and height."""
FACTOR = 2.0
"""Smallest growth factor of error or time that a title reports."""


def draw_error_against_time(problems: Sequence[ProblemRows], notes: Sequence[str], look: Styles, axis: Axis) -> Figure:
    """Draw relative RMSE against the time of one estimate, a panel per problem, a curve per estimator.

    A curve joins the values of the axis in order, labelled with them, on the backend with the lowest median time. All
    panels have the same scales. The title summarises how error and time change along the axis.
    """
    drawn = [fastest(estimator_curves(problem.rows, close=None)) for problem in problems]
    entries = {
        line.label: Line2D([], [], label=plain(line.label), **look.marked(line)) for part in drawn for line in part
    }
    across = columns(len(problems), 2)
    figure, panels = page(
        problems, across, 2.4, ("relative RMSE",), headline(list(zip(problems, drawn, strict=True)), axis),
        [*shared(problems, axis.column), *notes, f"numbers: {axis_name(axis)}", "each estimator on its fastest backend"],
        (list(entries.values()), [Patch(label="worse than the zero estimate", **SHADE)]),
    )  # fmt: skip
    known = [TIME.known(line.rows) for part in drawn for line in part]
    extent = [_scale_ends([value for rows in known for value in rows[name]]) for name in ("time_s", "rmse_rel")]
    for (panel,), curves in zip(panels, drawn, strict=True):
        log_axis(panel, "x", *extent[0], text=TIME.text)
        log_axis(panel, "y", *extent[1])
        if extent[1][1] > 1:
            panel.axhspan(1.0, extent[1][1], zorder=0, **SHADE)
        taken = [(x - 0.008, y, 0.016) for line in curves for _, x, y in _panel_positions(panel, TIME.known(line.rows))]
        for line in curves:
            rows = TIME.known(line.rows).sort_index()
            style = {**look.marked(line), "markersize": 3.5, "alpha": 0.85}
            panel.plot(rows["time_s"], rows["rmse_rel"], label=line.label, **style)
            _label(panel, rows, look.line(line)["color"], taken)
        panel.set_xlabel(TIME.label)
    return figure


def fastest(curves: Sequence[Curve]) -> list[Curve]:
    """Return each estimator's curve on the backend with the lowest median time; curves without times are omitted."""
    best: dict[str, tuple[float, Curve]] = {}
    for line in curves:
        median = float(TIME.known(line.rows)["time_s"].median())
        if math.isfinite(median) and (line.label not in best or median < best[line.label][0]):
            best[line.label] = (median, line)
    return [line for _, line in best.values()]


def headline(parts: Sequence[tuple[ProblemRows, Sequence[Curve]]], axis: Axis) -> str:
    """Summarise how error and time grow along the axis, for the estimator that is most accurate at its first value.

    The title names the problem where the error grows most and the problem where it grows least.
    """
    texts: list[tuple[float, str]] = []
    for problem, curves in parts:
        named = winners(curves)
        first = named[min(named)][0] if named else ""
        line = next((line for line in curves if line.label == first), None)
        rows = TIME.known(line.rows).sort_index() if line is not None else None
        if rows is None or len(rows) < 2:
            continue
        factors = [float(rows[name].max() / rows[name].iloc[0]) for name in ("rmse_rel", "time_s")]
        grown = [
            f"{what} up to {number(f)} times" for what, f in zip(("error", "time"), factors, strict=True) if f >= FACTOR
        ]
        text = f"{first} {' and '.join(grown)}" if grown else f"neither error nor time of {first} doubles"
        kinds = [str(value) for name, value in problem.identity.items() if name in CATEGORIES]
        texts.append((factors[0], f"{kinds[-1] if kinds else problem.title()}: {text}"))
    if not texts:
        return f"Error against time along {axis.column}"
    extremes = dict.fromkeys(text for _, text in (max(texts), min(texts)))
    return f"Along {axis.column}, " + "; ".join(extremes)


def _scale_ends(values: Sequence[float]) -> tuple[float, float]:
    """Return the lower and upper end of a scale, with a margin for labels."""
    low, high = min(values), max(values)
    margin = max(high / low, 4.0) ** 0.12
    return low / margin, high * margin


def _panel_positions(panel: Axes, rows: Any) -> list[tuple[float, float, float]]:
    """Return each point's value of the axis and its x and y as shares of the panel's width and height."""
    ends = [np.log(panel.get_xlim()), np.log(panel.get_ylim())]
    at = [(np.log(rows[n]) - e[0]) / (e[1] - e[0]) for n, e in zip(("time_s", "rmse_rel"), ends, strict=True)]
    return list(zip(map(float, rows.index), *(part.to_numpy(float) for part in at), strict=True))


def _label(panel: Axes, rows: Any, colour: str, taken: list[tuple[float, float, float]]) -> None:
    """Label a curve's points with the axis values. Points too close for separate labels share one: ``10-1000``."""
    runs: list[list[tuple[float, float, float]]] = []
    for point in _panel_positions(panel, rows):
        if runs and all(abs(point[i + 1] - runs[-1][0][i + 1]) < APART[i] for i in (0, 1)):
            runs[-1].append(point)
        else:
            runs.append([point])
    for run in runs:
        text = axis_value(run[0][0]) + (f"-{axis_value(run[-1][0])}" if len(run) > 1 else "")
        x, y = max(p[1] for p in run) + 0.02, float(np.mean([p[2] for p in run]))
        wide = LETTER[0] * len(text)
        if x + wide > 1:
            x = min(p[1] for p in run) - 0.02 - wide
        place = _free_height(x, y, wide, taken)
        if math.isfinite(place):
            taken.append((x, place, wide))
            panel.text(x, place, text, transform=panel.transAxes, color=colour, fontsize=5.5, va="center", zorder=5)


def _free_height(x: float, y: float, wide: float, taken: Sequence[tuple[float, float, float]]) -> float:
    """Return the height nearest to ``y`` where a label overlaps no other, as a share of the panel; NaN if none is near."""
    for step in (0, 1, -1, 2, -2, 3, -3):
        place = y + step * LETTER[1] / 2
        if all(abs(place - b) >= LETTER[1] * 0.9 or x + wide <= a or a + w <= x for a, b, w in taken) and 0 < place < 1:
            return place
    return math.nan
