"""Draws three kinds of charts: bias and variance along an axis, error against cost, and an overview."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.path import Path
from matplotlib.transforms import Transform

from bench.experiment.axes import Axis
from bench.report.page import columns, page, shared
from bench.report.problems import ProblemRows
from bench.report.scales import above, extent, log_axis, mark_values, scale_x, scale_y, shifts
from bench.report.style import (
    CROSS,
    DEVIANT,
    GREY,
    MARKS,
    SHADE,
    SIZE,
    TICK,
    Styles,
    axis_name,
    backend_rank,
    plain,
    quantity,
    width_in_inches,
)
from bench.report.views import Curve, estimator_curves, is_bias_resolved, pareto, rmse_interval
from bench.studies.bias_variance.costs import Cost
from bench.studies.bias_variance.findings import failure_summary, headline

ALIKE = 0.03
"""Largest relative difference at which backends are drawn as one line: it would not be visible."""
FLOOR = 1e-4
"""Relative biases below this, and variances below its square, are drawn at the lower edge."""
DOWN, LEFT = (
    Path(ends, [Path.MOVETO, Path.LINETO, Path.MOVETO, Path.LINETO, Path.LINETO])
    for ends in (
        [(0, -0.25), (0, -1), (-0.17, -0.78), (0, -1), (0.17, -0.78)],
        [(-0.25, 0), (-1, 0), (-0.78, -0.17), (-1, 0), (-0.78, 0.17)],
    )
)
"""Arrow markers from upper limits towards 0, of a fixed length on paper."""


def bias_variance(
    problems: Sequence[ProblemRows], notes: Sequence[str], look: Styles, axis: Axis, marks: Mapping[str, float]
) -> Figure:
    """Draw relative RMSE, bias and variance against one axis, below each other, a column of panels per problem.

    The title states where the most frequently best estimator fails.
    """
    drawn = [estimator_curves(problem.rows, ALIKE) for problem in problems]
    across = columns(len(problems), 4)
    figure, panels = page(
        problems, across, 4.5, ("relative RMSE", "|bias| / |∇J|", "variance / |∇J|²"),
        headline(list(zip(problems, drawn, strict=True)), axis, marks), [*shared(problems, axis.column), *notes],
        _line_legends(drawn, look, axis, marks),
    )  # fmt: skip
    for stack, curves in zip(panels, drawn, strict=True):
        values = np.array(sorted({x for line in curves for x in line.at}))
        for line, shift in zip(curves, shifts(values, len(curves), across), strict=True):
            style = look.marked(line) | _deviation(line, curves)
            for panel, (column, power) in zip(stack, (("rmse", 1), ("bias", 1), ("variance", 2)), strict=True):
                _draw_errors(panel, line, shift + panel.transData, style, column, power)
        for panel in stack:
            scale_x(panel, values)
            mark_values(panel, marks)
        for panel in stack[:-1]:
            panel.tick_params(labelbottom=False)
        stack[-1].set_xlabel(axis_name(axis))
    together = len({problem.rows["scene"].iloc[0] for problem in problems}) == 1
    step = across if together else 1
    for start in range(0, len(panels), step):
        for row in zip(*panels[start : start + step], strict=True):
            scale_y(row)
    return figure


def _deviation(line: Curve, curves: Sequence[Curve]) -> dict[str, Any]:
    """Return the line style of a backend whose numbers differ from the first backend's; empty for the first."""
    place = backend_rank(line, curves)
    return {"linestyle": DEVIANT[(place - 1) % len(DEVIANT)]} if place else {}


@dataclass(frozen=True)
class Points:
    """Values to draw with their intervals, relative to |grad J|. Arrays have shape ``(n,)``, one entry per known value."""

    known: np.ndarray
    """Mask over all rows: whether a row has a value. The other arrays contain only the rows that have one."""
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    limit: np.ndarray
    """Whether the value is an upper limit or at the lower edge of the scale."""


def _estimates(rows: pd.DataFrame, column: str, power: int) -> Points:
    """Return the points of a column, ``rmse``, ``bias`` or ``variance``, divided by |grad J| to the ``power``."""
    names = (column, "reference_norm", *(f"{part}_{end}" for part in ("bias", "variance") for end in ("low", "high")))
    read = {name: rows[name].to_numpy(float) for name in names}
    scale = _scale(rows)
    with np.errstate(invalid="ignore", divide="ignore"):
        if column == "rmse":
            ends = list(rmse_interval(read))
        else:
            ends = [read[f"{column}_{end}"] / scale**power for end in ("low", "high")]
        value = read[column] / scale**power
        limit = ~(read["bias_low"] > 0) & (column == "bias")
        value = np.where(limit, ends[1], value)
        floor = FLOOR**power
        known = (rows["status"] == "ok").to_numpy(bool) & np.isfinite(value)
        low, high = (end[known] for end in ends)
        return Points(known, value[known].clip(floor), low.clip(floor), high, (limit | (value <= floor))[known])


def _scale(rows: pd.DataFrame) -> np.ndarray:
    """Return |grad J| per row, or 1 where it is 0 or not finite."""
    norm = rows["reference_norm"].to_numpy(float)
    return np.where((norm > 0) & np.isfinite(norm), norm, 1.0)


def _draw_errors(panel: Axes, line: Curve, place: Transform, style: Mapping[str, Any], column: str, power: int) -> None:
    """Draw one curve's RMSE, bias or variance with the transform ``place``, and crosses where cells failed."""
    points, at = _estimates(line.rows, column, power), line.rows.index.to_numpy(float)
    curve = {**style, "marker": "", "alpha": 0.75}
    panel.plot(at[points.known], points.value, label=line.label, transform=place, **curve)
    _draw_points(panel, at[points.known], points, {**style, "transform": place})
    lost = at[~points.known | (line.rows["lost"].to_numpy() > 0)]
    if len(lost):
        height = 0.955 - 0.05 * (sum(other.get_marker() == "x" for other in panel.lines) % 4)
        panel.plot(
            lost, [height] * len(lost), transform=above(panel, place), color=style["color"], clip_on=False,
            zorder=4, **CROSS,
        )  # fmt: skip


def _draw_points(panel: Axes, at: np.ndarray, points: Points, style: Mapping[str, Any], lying: bool = False) -> None:
    """Draw filled markers with intervals, and hollow markers with arrows at upper limits.

    ``at`` are the positions on the other axis. With ``lying`` the values are on the horizontal axis.
    """
    mark: Any = {
        "color": style["color"],
        "linestyle": "none",
        "zorder": 3,
        "transform": style.get("transform", panel.transData),
    }
    limit, clear = points.limit, ~points.limit
    bars = np.array([(points.value - points.low)[clear], (points.high - points.value)[clear]])
    bars = np.nan_to_num(bars, posinf=0.0).clip(min=0.0)
    centres: Any = (at[clear], points.value[clear])
    limits: Any = (at[limit], points.value[limit])
    if lying:
        centres, limits = centres[::-1], limits[::-1]
    error: Any = {"xerr": bars} if lying else {"yerr": bars}
    panel.errorbar(centres[0], centres[1], elinewidth=0.8, marker=style["marker"], **error, **mark)
    panel.plot(*limits, marker=style["marker"], markerfacecolor="white", markeredgewidth=0.9, **mark)
    panel.plot(*limits, marker=LEFT if lying else DOWN, markersize=18, markerfacecolor="none", **mark)


def _line_legends(
    drawn: Sequence[Sequence[Curve]], look: Styles, axis: Axis, marks: Mapping[str, float]
) -> tuple[list[Any], list[Any]]:
    """Return two lists of legend handles: the estimators, and the symbols."""
    every = [(line, curves) for curves in drawn for line in curves]
    entries = {line.label: _handle(line.label, **look.marked(line)) for line, _ in every}
    deviants: dict[Any, list[str]] = {}
    for line, curves in every:
        if style := _deviation(line, curves):
            deviants.setdefault(style["linestyle"], []).extend(line.backends)
    symbols: list[Any] = []
    for dashes, names in deviants.items():
        symbols.append(_handle(f"{', '.join(dict.fromkeys(names))}, where different", linestyle=dashes))
    rows = pd.concat([line.rows for line, _ in every])
    good = rows[rows["status"] == "ok"]
    texts = ["bias not distinguishable from 0: 95% limit"] * bool((~is_bias_resolved(good)).any())
    texts += ["below the scale"] * bool(_estimates(rows, "variance", 2).limit.any())
    if texts:
        symbols.append(_handle(", or ".join(texts), marker="o", markerfacecolor="white", linestyle="none"))
    if (rows["lost"] > 0).any():
        symbols.append(_handle("cell failed", **CROSS))
    symbols.append(Patch(label="error exceeds |∇J|", **SHADE))
    for (text, value), dashes in zip(marks.items(), MARKS * len(marks), strict=False):
        label = f"{plain(text)}, {quantity(axis.column, value)}"
        symbols.append(Line2D([], [], color="#595959", linewidth=0.9, linestyle=dashes, label=label))
    return list(entries.values()), symbols


def _handle(text: str, color: str = GREY, **style: Any) -> Line2D:
    return Line2D([], [], label=plain(text), color=color, **style)


BACKENDS = ("solid", (0, (4, 1.5)), (0, (1, 1.2)), (0, (5, 1, 1, 1)), (0, (8, 2)))
"""Line styles of backends, in order of appearance."""


def speed_accuracy(
    problems: Sequence[ProblemRows],
    notes: Sequence[str],
    look: Styles,
    cost: Cost,
    sentences: Mapping[int, str],
    first: str,
) -> Figure:
    """Draw relative RMSE of one estimate against its cost, a panel per problem, a curve per estimator and backend.

    Colour and marker show the estimator, the line style the backend. The estimator's name is at the end of its cheapest
    curve. Along the thin grey guide the error falls as N^-1/2. A dotted line is a bias that more samples do not remove.
    ``sentences`` are texts below the panels by position of the problem, ``first`` is the title.
    """
    drawn = [estimator_curves(problem.rows, close=None) for problem in problems]
    every = [line for curves in drawn for line in curves]
    backends = list(dict.fromkeys(line.rows["backend"].iloc[0] for line in every))
    dashes = {name: BACKENDS[i % len(BACKENDS)] for i, name in enumerate(backends)}
    entries = {line.label: _handle(line.label, **{**look.marked(line), "linestyle": "none"}) for line in every}
    symbols: list[Any] = [_handle(name, linestyle=dashes[name]) for name in backends]
    symbols += [
        Line2D([], [], **GUIDE, label="error falling as $N^{-1/2}$"),
        Line2D([], [], color=GREY, linewidth=0.9, linestyle=":", label="bias, which samples do not remove"),
        Patch(label="worse than the zero estimate", **SHADE),
    ]
    across = columns(len(problems), 2)
    figure, panels = page(
        problems, across, 2.3, ("relative RMSE",),
        first, [f"relative RMSE of one estimate against {cost.name}", *shared(problems, "samples"), *notes],
        (list(entries.values()), symbols),
    )  # fmt: skip
    for place, ((panel,), problem, curves) in enumerate(zip(panels, problems, drawn, strict=True)):
        for line in curves:
            style = {**look.marked(line), "linestyle": dashes[line.rows["backend"].iloc[0]], "markersize": 3}
            _draw_curve(panel, line, cost, style)
        _draw_scales(panel, cost.known(problem.rows), cost)
        _draw_guide(panel, cost.known(problem.rows), cost)
        _name_curves(panel, curves, cost, look, figure.get_figwidth() / across - MARGIN)
        room = 132 // across
        wrapped_lines = ["\n".join(textwrap.wrap(text, room)) for text in sentences.get(place, "").splitlines()]
        panel.set_xlabel("\n".join([cost.label, *wrapped_lines]), fontsize=6.2)
    return figure


NAME_SIZE = 6
"""Font size in points of the names beside curves."""
APART = 0.075
"""Least distance between two names, as a share of a panel's height."""
MARGIN = 0.75
"""Most inches that the labels beside a panel take."""
GUIDE: dict[str, Any] = {"color": "#b0b0b0", "linewidth": 0.8, "zorder": 0.4}


def _draw_curve(panel: Axes, line: Curve, cost: Cost, style: Mapping[str, Any]) -> None:
    rows = cost.known(line.rows)
    if rows.empty:
        return
    spread, at = cost.spread(rows), cost.of(rows)
    bars = [np.minimum(spread, 0.9 * at), spread]
    panel.errorbar(at, rows["rmse_rel"], xerr=bars, elinewidth=0.7, label=line.label, **style)
    last = rows.sort_index().iloc[-1]
    if last["bias_low"] > 0 and last["bias"] > 0.5 * last["rmse"]:
        floor = last["bias"] / last["reference_norm"]
        drawn = [other for other in panel.lines if other.get_linestyle() == ":" and other.get_color() == style["color"]]
        if any(abs(math.log(float(np.ravel(other.get_ydata())[0]) / floor)) < ALIKE for other in drawn):
            return  # another backend's line is already there
        panel.axhline(floor, color=style["color"], linewidth=0.9, linestyle=":", zorder=0.6)
        panel.text(
            0.01 + 0.07 * sum(text.get_text() == "bias" for text in panel.texts), floor, "bias", transform=panel.get_yaxis_transform(), color=style["color"], fontsize=NAME_SIZE - 0.5,
            va="bottom", zorder=5,
        )  # fmt: skip


def _draw_guide(panel: Axes, rows: pd.DataFrame, cost: Cost) -> None:
    """Draw a line of slope -1/2 across the panel, through the most expensive point of the Pareto front."""
    at = cost.of(rows)
    best = rows.assign(at=at)[pareto(at, rows["rmse_rel"])].sort_values("at").iloc[-1]
    ends = np.array(panel.get_xlim())
    panel.plot(
        ends, best["rmse_rel"] * (ends / best["at"]) ** -0.5, label="_guide", scalex=False, scaley=False, **GUIDE
    )


def _name_curves(panel: Axes, curves: Sequence[Curve], cost: Cost, look: Styles, width: float) -> None:
    """Label the end of each estimator's cheapest curve with its name; names do not overlap and fit ``width`` inches."""
    ends: dict[str, tuple[float, float, Curve]] = {}
    for line in curves:
        rows = cost.known(line.rows)
        if not rows.empty:
            last = rows.sort_index().iloc[-1]
            at = float(cost.of(rows.sort_index()).iloc[-1])
            if line.label not in ends or at < ends[line.label][0]:
                ends[line.label] = (at, float(last["rmse_rel"]), line)
    low, high = np.log(panel.get_ylim())
    named = sorted(ends.items(), key=lambda item: item[1][1])
    heights = apart([(np.log(error) - low) / (high - low) for _, (_, error, _) in named], APART, 0.04, 0.96)
    for (label, (at, _, line)), height in zip(named, heights, strict=True):
        left, right = np.log(panel.get_xlim())
        x = min((np.log(at) - left) / (right - left) + 0.03, 1.0 - width_in_inches(label) * NAME_SIZE / SIZE / width)
        panel.text(
            x, height, plain(label), transform=panel.transAxes, color=look.line(line)["color"], fontsize=NAME_SIZE, va="center",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.3, "alpha": 0.75}, zorder=5,
        )  # fmt: skip


def apart(heights: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Return increasing heights, shifted to be ``gap`` apart, at most ``high`` and, if there is space, at least ``low``."""
    moved: list[float] = []
    for height in heights:
        moved.append(max(height, moved[-1] + gap if moved else low))
    for i in reversed(range(len(moved))):
        moved[i] = min(moved[i], moved[i + 1] - gap if i + 1 < len(moved) else high)
    return moved


def _draw_scales(panel: Axes, rows: pd.DataFrame, cost: Cost) -> None:
    """Set the panel's scales, with space at the right for names, and shade errors above the zero estimate's."""
    at = cost.of(rows)
    low, high = rows["rmse_rel"].min(), rows["rmse_rel"].max()
    spread = np.minimum(cost.spread(rows), at / 2)
    first, last = (at - spread).min(), (at + spread).max()
    tall, wide = max(high / low, 4.0) ** 0.08, max(last / first, 4.0) ** 0.08
    log_axis(panel, "x", first / wide, last * wide * (last / first) ** 0.3, text=cost.text)
    log_axis(panel, "y", low / tall, high * tall)
    if high * tall > 1:
        panel.axhspan(1.0, high * tall, zorder=0, **SHADE)


def overview(problems: Sequence[ProblemRows], notes: Sequence[str], look: Styles) -> Figure:
    """Draw relative bias and RMSE of every estimator, a panel per problem; the title summarises which estimators fail."""
    every = [estimator_curves(problem.rows, ALIKE) for problem in problems]
    drawn = [{_row_label(line, curves): line for line in curves} for curves in every]
    labels = list(dict.fromkeys(label for curves in drawn for label in curves))
    symbols: list[Any] = [
        _handle("relative bias, 95% interval", marker="o", linestyle="none"),
        _handle("not distinguishable from 0", marker="o", markerfacecolor="white", linestyle="none"),
        _handle("relative RMSE", **TICK),
        Patch(label="error exceeds |∇J|", **SHADE),
    ]
    if any(line.failed for curves in drawn for line in curves.values()):
        symbols.append(_handle("cell failed", **CROSS))
    figure, panels = page(
        problems, columns(len(problems), 3), 0.55 + 0.24 * len(labels), ("",),
        failure_summary(list(zip(problems, every, strict=True))),
        ["Relative bias and RMSE of one estimate", *shared(problems, ""), *notes], ([], symbols), sharey=True,
    )  # fmt: skip
    for (panel,), curves in zip(panels, drawn, strict=True):
        for label, line in curves.items():
            _draw_dot(panel, line, len(labels) - 1 - labels.index(label), look.line(line)["color"])
        low, high = extent([panel], "x", 0.3, 2.0)
        margin = (high / low) ** 0.08
        log_axis(panel, "x", low / margin**2, high * margin)
        panel.axvspan(1.0, high * margin, zorder=0, **SHADE)
        panel.set_ylim(-0.6, len(labels) - 0.4)
        panel.set_yticks(range(len(labels)), [plain(label) for label in reversed(labels)])
        panel.tick_params(axis="y", length=0)
        panel.set_xlabel("in units of |∇J|")
    return figure


def _row_label(line: Curve, curves: Sequence[Curve]) -> str:
    unique = sum(other.label == line.label for other in curves) == 1
    return line.label if unique else f"{line.label}, {'/'.join(line.backends)}"


def _draw_dot(panel: Axes, line: Curve, height: int, colour: str) -> None:
    panel.axhline(height, color="#e5e5e5", linewidth=0.6, zorder=0)
    rows = line.rows
    error = rows["rmse"] / _scale(rows)
    good = (rows["status"] == "ok") & np.isfinite(error)
    points = _estimates(rows[good], "bias", 1)
    _draw_points(panel, np.full(len(points.value), height), points, {"color": colour, "marker": "o"}, lying=True)
    panel.plot(error[good].clip(lower=FLOOR), [height] * good.sum(), color=colour, label=line.label, **TICK)
    if not good.all() or (rows["lost"] > 0).any():
        panel.plot([0.97], [height], transform=panel.get_yaxis_transform(), color=colour, **CROSS)
