"""Draws the summary matrix: each estimator's cost to reach an error on each problem, and the cheapest estimator's lead."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle

from bench.report.problems import ProblemRows
from bench.report.style import plain
from bench.report.text import counted, number
from bench.studies.bias_variance.costs import ROLLOUTS, Cost
from bench.studies.bias_variance.time_to_accuracy import TARGETS, RequiredCost, lead, methods

FIRST = "#009E73"
SHADES = (
    (1.0, "#009E73", "white"),
    (3.0, "#7fcbb3", "black"),
    (30.0, "#dff2ec", "black"),
    (math.inf, "#f4f4f4", "black"),
)
"""Largest ratio of a cell's cost to the lowest cost of its column, with the colours of the cell and its text."""
WHY = {"never": "bias", "unknown": "bias?"}
"""Text of a cell without a cost, by ``RequiredCost.how``."""
LEGEND = (
    "Dark and bold: the first of its column; lighter: up to 3, and up to 30 times as much. Lead: the first over the next "
    "estimator, with its 95% interval; open where that reaches 1. bias: its bias is larger than the error. bias?: no bias known to be below the error."
)
LEAD = "lead over the next"


def draw_summary_matrix(problems: Sequence[ProblemRows], costs: Sequence[Cost]) -> Figure:
    """Draw one matrix per kind of cost and target error: estimators down, problems across.

    A cell is the cost on the best backend, coloured by its ratio to the lowest cost of the column. The last row is the
    ratio of the second lowest cost to the lowest, with its 95% interval.
    """
    costs_by_target = {
        (cost, target): [_best(methods(problem, target, cost)) for problem in problems]
        for cost in costs
        for target in TARGETS
    }
    names = list(dict.fromkeys(name for columns in costs_by_target.values() for column in columns for name in column))
    size = max(6.0, 1.5 + 0.93 * len(problems)), 0.9 + (0.45 + 0.27 * (len(names) + 1)) * len(costs_by_target)
    figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(rect=(0.01, 0.0, 0.98, 1.0)))
    FigureCanvasAgg(figure)
    figure.suptitle(
        f"{_title(costs_by_target)}\nWhat one estimate needs, on its best backend", fontsize=9, fontweight="bold"
    )
    figure.supxlabel(textwrap.fill(LEGEND, int(19 * size[0])), fontsize=6.5)
    panels = figure.subplots(len(costs_by_target), 1, squeeze=False)[:, 0]
    for panel, ((cost, target), columns) in zip(panels, costs_by_target.items(), strict=True):
        _matrix(panel, columns, names, cost)
        panel.set_title(f"{target:.0%} error: {cost.label}", fontsize=8, loc="left", fontweight="bold")
        panel.set_xticks(range(len(problems)), [plain(p.title().partition(",")[0]) for p in problems], fontsize=6.5)
        panel.set_yticks(range(len(names) + 1), [*map(plain, names), LEAD], fontsize=7)
    return figure


def _title(costs_by_target: Mapping[tuple[Cost, float], Sequence[Mapping[str, tuple[RequiredCost, str]]]]) -> str:
    """Format which estimator is first on most problems, for the first kind of cost and target error."""
    (cost, target), columns = next(iter(costs_by_target.items()))
    firsts = Counter(_first(column) for column in columns)
    unsure = firsts.pop(None, 0)
    if not firsts:
        return f"Which estimator is first to {target:.0%} error is not distinguishable on any problem"
    name, times = firsts.most_common(1)[0]
    kind = "rollouts" if cost is ROLLOUTS else "time"
    title = f"{name} is first to {target:.0%} error by {kind} on {times} of {counted(len(columns), 'problem')}"
    return title + (f", open on {unsure}" if unsure else "")


def _first(column: Mapping[str, tuple[RequiredCost, str]]) -> str | None:
    """Return the estimator with the lowest cost; None without any, or if its lead may be due to chance."""
    if _lead(column) in ("", "open"):
        return None
    return min((name for name in column if math.isfinite(column[name][0].cost)), key=lambda name: column[name][0].cost)


def _best(reached: Mapping[str, RequiredCost]) -> dict[str, tuple[RequiredCost, str]]:
    """Return each estimator's lowest cost over backends, and the backend."""
    best: dict[str, tuple[RequiredCost, str]] = {}
    for name, way in reached.items():
        estimator, _, backend = name.partition(" on ")
        known = best.get(estimator)
        if known is None or math.isnan(known[0].cost) or way.cost < known[0].cost:
            best[estimator] = (way, backend)
    return best


def _matrix(
    panel: Any, columns: Sequence[Mapping[str, tuple[RequiredCost, str]]], names: Sequence[str], cost: Cost
) -> None:
    panel.set_xlim(-0.5, len(columns) - 0.5)
    panel.set_ylim(len(names) + 0.5, -0.5)
    panel.tick_params(length=0)
    for spine in panel.spines.values():
        spine.set_visible(False)
    for x, column in enumerate(columns):
        least = min((way.cost for way, _ in column.values() if math.isfinite(way.cost)), default=math.nan)
        for y, name in enumerate(names):
            way, backend = column.get(name, (RequiredCost("unknown"), ""))
            factor = way.cost / least
            back, front = ("white", "#595959")
            text = WHY.get(way.how, "-")
            if math.isfinite(way.cost):
                back, front = next((b, f) for most, b, f in SHADES if factor <= most)
                text = cost.text(float(number(way.cost))) + (f"\n{backend}" if backend else "")
            panel.add_patch(Rectangle((x - 0.48, y - 0.46), 0.96, 0.92, facecolor=back, edgecolor="none"))
            weight = "bold" if factor == 1.0 else "normal"
            panel.text(
                x, y, text, ha="center", va="center", fontsize=5.5, color=front, fontweight=weight, linespacing=0.95
            )
        panel.text(x, len(names), _lead(column), ha="center", va="center", fontsize=5.5, linespacing=0.95)


def _lead(column: Mapping[str, tuple[RequiredCost, str]]) -> str:
    """Format the ratio of the second lowest cost to the lowest, with its 95% interval.

    The text is ``open`` where the interval reaches 1, ``alone`` for a single estimator with a cost, and empty for none.
    """
    ways = sorted((way for way, _ in column.values() if math.isfinite(way.cost)), key=lambda way: way.cost)
    if len(ways) < 2:
        return "alone" if ways else ""
    factor, low, high = lead(ways[0], ways[1])
    return f"{number(factor)} times\n({number(low)} to {number(high)})" if low > 1.0 else "open"
