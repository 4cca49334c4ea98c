"""Functions shared by the studies' reports: tables in files and on the terminal, intervals, and titled figures."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console

from bench.experiment.axes import Axis, table
from bench.experiment.experiment import Experiment
from bench.report import terminal
from bench.report.page import WIDTH, columns
from bench.report.problems import part_columns, problem_numbers
from bench.report.text import counted, number
from bench.report.views import Arranged
from bench.report.web.content import distinguishing_columns
from bench.run.files import write_all

TITLE_WIDTH = 86
"""Characters of a line of a figure's title, in a figure of full width."""


# ------------------------------------------------------------------------------------------------------- tables


def interval(
    row: Mapping[Any, Any], name: str, low: str = "", high: str = "", factor: float = 1.0, digits: int = 2
) -> str:
    """Return a number of a row with its interval as a string, ``0.5 [0.4, 0.6]``, or ``-`` if the number is missing.

    The ends are the columns ``name_low`` and ``name_high`` unless ``low`` and ``high`` name other columns. All three
    values are multiplied by ``factor``.
    """
    values = [row[column] * factor for column in (name, low or f"{name}_low", high or f"{name}_high")]
    return "-" if math.isnan(values[0]) else "{} [{}, {}]".format(*(number(value, digits) for value in values))


def label_columns(
    shown: Arranged,
    parts: Sequence[str],
    without: Sequence[Axis] = (),
    always: Sequence[str] = ("scene", "contact"),
    rows: pd.DataFrame | None = None,
) -> list[str]:
    """Return the columns that distinguish rows with different ``parts``, ignoring the axes ``without``.

    ``always`` are columns to return even if they distinguish nothing. ``rows`` are some rows of ``shown``, by default
    all.
    """
    rows = shown.rows if rows is None else rows
    return distinguishing_columns(
        rows, problem_numbers(rows, parts, without), part_columns(shown, parts, without), always
    )


def write_tables(
    experiment: Experiment,
    rows: pd.DataFrame,
    stem: str,
    paragraphs: Sequence[str],
    further: Mapping[str, str] = MappingProxyType({}),
) -> list[Path]:
    """Write all columns as ``stem.csv``, paragraphs as ``stem.md``, and ``further`` files by name; return all paths."""
    contents = {
        f"{stem}.csv": table(experiment, rows).to_csv(index=False, lineterminator="\n"),
        f"{stem}.md": "\n\n".join(paragraphs) + "\n",
        **further,
    }
    return write_all(experiment.directory, contents)


# ----------------------------------------------------------------------------------------------------- terminal


def open_console(experiment: Experiment, rows: pd.DataFrame) -> Console:
    """Print the experiment's question and the number of cells by status; return the console for further output."""
    console = terminal.open_console()
    console.print(f"\n{experiment.name}: {experiment.question}" if experiment.question else f"\n{experiment.name}")
    counts = rows["status"].value_counts()
    console.print(f"{counted(len(rows), 'cell')}: " + ", ".join(f"{n} {status}" for status, n in counts.items()))
    return console


def print_table(
    console: Console,
    texts: pd.DataFrame,
    heads: Mapping[str, str] = MappingProxyType({}),
    right: Collection[str] = (),
    title: str = "",
) -> None:
    """Print a table of strings. ``heads`` replaces column names, and the columns ``right`` are right-aligned."""
    terminal.print_table(console, texts, title, heads=heads, right=right)


def print_reasons(console: Console, rows: pd.DataFrame) -> None:
    """Print each distinct reason in the rows once."""
    for reason in rows.loc[rows["reason"] != "", "reason"].unique():
        console.print(reason)


# ------------------------------------------------------------------------------------------------------ figures


def titled_figure(width: float, height: float, title: str) -> Figure:
    """Return an empty figure of ``width`` by ``height`` inches with a bold title, wrapped to its width."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    limit = int(TITLE_WIDTH * width / WIDTH)
    lines = [textwrap.fill(line, limit) for line in title.splitlines()]
    figure.suptitle("\n".join(lines), fontsize=9, fontweight="bold")
    return figure


def panel_grid(
    count: int, most: int, height: float, title: str, margin: float = 1.0, sharey: bool = False
) -> tuple[Figure, list[Axes]]:
    """Return a titled figure and its ``count`` panels, at most ``most`` side by side.

    ``height`` is the height of a row of panels and ``margin`` the height of title and legend, both in inches.
    """
    across = columns(count, most)
    down = math.ceil(count / across)
    figure = titled_figure(WIDTH, height * down + margin, title)
    panels = list(figure.subplots(down, across, squeeze=False, sharey=sharey).ravel())
    for spare in panels[count:]:
        spare.remove()
    return figure, panels[:count]
