"""Functions shared by the studies: the columns that label the lines of a table, and tables on the terminal."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType

import pandas as pd
from rich.console import Console

from bench.experiment.axes import Axis
from bench.experiment.experiment import Experiment
from bench.report import terminal
from bench.report.problems import part_columns, problem_numbers
from bench.report.text import counted
from bench.report.views import Arranged
from bench.report.web.content import distinguishing_columns


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
