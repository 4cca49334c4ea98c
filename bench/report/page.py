"""Lays out a figure of panels: a title, titled panels, and legends below them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from bench.report.problems import ProblemRows
from bench.report.style import plain, quantity, width_in_inches, wrapped
from bench.report.views import CATEGORIES

WIDTH, NARROW = 7.16, 3.5
"""Figure widths in inches: two columns of a paper, or one for a single panel. Fonts keep their size in print."""
LINE = 0.16
"""Height of a line of text in inches."""
BOLD = 1.32
"""Width of a figure's bold title relative to the same text elsewhere."""
PLACES: Any = ("upper center", "lower center")


def columns(count: int, most: int) -> int:
    """Return the number of panels side by side, at most ``most``, that fills the rows evenly."""
    return math.ceil(count / math.ceil(count / most))


def page(
    problems: Sequence[ProblemRows],
    across: int,
    height: float,
    labels: Sequence[str],
    title: str,
    subtitle: Sequence[str],
    legends: Sequence[Sequence[Any]],
    sharey: bool = False,
) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure and the panels of each problem, in reading order.

    A problem has one panel per label, below each other, with a total height of ``height`` inches. ``across`` problems
    are side by side.
    """
    width = WIDTH if across > 1 else NARROW
    titles = _panel_titles(problems, 0.86 * width / across)
    blocks = math.ceil(len(problems) / across)
    head = wrapped(subtitle, 0.97 * width)
    title = wrapped(title.split(), 0.97 * width / BOLD, " ")
    counts = [_legend_columns(part, width) for part in legends]
    named = 0.25 + LINE * title.count("\n")
    above = named + LINE * (head.count("\n") + 1)
    middle = blocks * (height + LINE * max(text.count("\n") + 1 for text in titles))
    below = 0.15 + 0.15 * sum(math.ceil(len(part) / count) for part, count in zip(legends, counts, strict=True))
    layout = ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03, rect=(0.005, 0, 0.99, 1))
    figure = Figure(figsize=(width, above + middle + below), layout=layout)
    FigureCanvasAgg(figure)
    top, centre, bottom = figure.subfigures(3, 1, height_ratios=[above, middle, below], squeeze=False)[:, 0]
    top.text(0.5, 1 - 0.07 / above, title, ha="center", va="top", fontsize=9, fontweight="bold")
    top.text(0.5, 1 - named / above, head, ha="center", va="top", color="#404040")
    _legends(bottom, legends, counts)
    grid = centre.subplots(blocks * len(labels), across, squeeze=False, sharey=sharey)
    return figure, _panels(grid, titles, labels)


def _panels(grid: np.ndarray, titles: Sequence[str], labels: Sequence[str]) -> list[list[Axes]]:
    """Return the titled and labelled panels of each problem, and remove unused panels."""
    blocks = grid.reshape(-1, len(labels), grid.shape[1]).swapaxes(1, 2)
    panels = blocks.reshape(-1, len(labels)).tolist()
    for spare in panels[len(titles) :]:
        for panel in spare:
            panel.remove()
    for stack, title in zip(panels, titles, strict=False):
        stack[0].set_title(title, pad=4)
    for first in blocks[:, 0]:
        for panel, label in zip(first, labels, strict=True):
            panel.set_ylabel(label)
    return panels[: len(titles)]


def _legend_columns(entries: Sequence[Any], width: float) -> int:
    """Return the largest number of legend columns that fits ``width`` inches; entries fill column after column."""
    lengths = np.array([0.6 + width_in_inches(entry.get_label()) for entry in entries])
    for count in range(len(lengths), 1, -1):
        if sum(column.max() for column in np.array_split(lengths, count)) <= width:
            return count
    return 1


def _legends(figure: SubFigure, legends: Iterable[Sequence[Any]], counts: Iterable[int]) -> None:
    """Draw two legends, at the upper and the lower edge of a figure."""
    for entries, count, place, anchor in zip(legends, counts, PLACES, (1, 0), strict=True):
        if entries:
            figure.legend(
                handles=list(entries), loc=place, bbox_to_anchor=(0.5, anchor), ncols=count, borderpad=0.1,
                labelspacing=0.25, handletextpad=0.5, columnspacing=1.2, borderaxespad=0.1,
            )  # fmt: skip


def _panel_titles(problems: Sequence[ProblemRows], width: float) -> list[str]:
    """Return the problems' titles. If any title is wider than ``width`` inches, all are broken before their numbers."""
    parts = [_title(problem) for problem in problems]
    if all(width_in_inches(", ".join(kinds + numbers)) <= width for kinds, numbers in parts):
        return [", ".join(kinds + numbers) for kinds, numbers in parts]
    return ["\n".join(wrapped(part, width) for part in both if part) for both in parts]


def _title(problem: ProblemRows) -> tuple[list[str], list[str]]:
    """Return the two parts of a problem's title: its categories, such as the scene, and its numbers."""
    kinds = [plain(str(value)) for name, value in problem.identity.items() if name in CATEGORIES]
    numbers = [quantity(name, value) for name, value in problem.identity.items() if name not in CATEGORIES]
    if not (problem.rows["reference_norm"] > 0).any():
        numbers.append("absolute: ∇J = 0")
    return kinds, numbers


def shared(problems: Sequence[ProblemRows], axis: str) -> list[str]:
    """Return the values that all panels have in common, which their titles omit; ``axis`` is the column drawn along."""
    rows = pd.concat([problem.rows for problem in problems])
    named = {axis, *(name for problem in problems for name in problem.identity)}
    parts = []
    for name in ("scene", "contact", "stiffness", "sigma", "horizon", "samples", "repeats"):
        values = rows[name].unique()
        if name in named or len(values) > 1 or values[0] in ("none", 0.0) or pd.isna(values[0]):
            continue
        parts.append(plain(values[0]) if name in CATEGORIES else quantity(name, values[0]))
    return parts
