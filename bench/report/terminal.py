"""Prints a table on the terminal, never wider than the terminal."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from textwrap import wrap

import pandas as pd
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.report.text import one_line

PIPE = 10_000
"""Characters of a line in a pipe: no table is wider."""
GAP = 2
"""Blanks between two columns."""
LONGEST = 24
"""Longest word, in characters, that is never broken."""
KEPT = "status"
"""The column that is left out last, after the first column."""
MOST_NAMES = 24
"""Most names of columns that are listed as left out."""


class _Console(Console):
    """Raises BrokenPipeError when the reader of the output has gone, where rich would exit with status 1."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def open_console() -> Console:
    """Return a console that prints names as they are, without markup. It is as wide as the terminal.

    ``COLUMNS`` replaces the width of the terminal, in a pipe too. A pipe without it is as wide as its tables.
    """
    found = _Console(highlight=False, markup=False, emoji=False)
    if not found.is_terminal and "COLUMNS" not in os.environ:
        found.width = PIPE
    return found


def print_table(
    console: Console, table: pd.DataFrame, title: str = "", right: Collection[str] = (), omitted: Sequence[str] = ()
) -> None:
    """Print a table of strings, as wide as the console at most.

    The columns ``right`` are right-aligned and never wrapped. Where the table is too wide, columns with one value are stated once
    above it, then text wraps, then columns are left out, from the right, and named below it, after what is ``omitted`` already.
    The first column and the status stay longest.
    """
    names, places = list(map(str, table)), range(table.shape[1])
    texts = [["\n".join(map(one_line, text.split("\n"))) for text in table.iloc[:, i].fillna("")] for i in places]
    whole = [name in right for name in names]  # columns whose cells are not wrapped
    least = [_least(names[i], texts[i], whole[i]) for i in places]
    visible, constant, left_out = list(places), [], []

    def spare() -> int:
        return console.width + GAP - sum(least[i] + GAP for i in visible)

    if spare() < 0 and len(table) > 1:
        constant = [i for i in visible[1:] if len(set(texts[i])) == 1]
        visible = [i for i in visible if i not in constant]
    for i in sorted(reversed(visible[1:]), key=lambda i: names[i] == KEPT):
        if spare() < 0:
            left_out.append(i)
            visible.remove(i)
    grid = Table(box=None, pad_edge=False, padding=(0, GAP, 0, 0), header_style="underline")
    for i in visible:
        head = "\n".join(wrap(names[i], least[i])) if whole[i] and spare() < cell_len(names[i]) else names[i]
        least[i] = max(least[i], *map(cell_len, head.split("\n"))) if whole[i] else least[i]
        grid.add_column(Text(head), justify="right" if whole[i] else "left", no_wrap=whole[i], overflow="fold")
    for line in zip(*(texts[i] for i in visible), strict=True):
        grid.add_row(*map(Text, line))
    facts = "; ".join(f"{names[i]}: {texts[i][0]}" for i in constant if texts[i][0])
    for text in filter(None, (title, facts)):
        console.print(Text(text), style="bold")
    console.print(grid)
    if left_out or omitted:
        listed = ", ".join([*omitted, *(names[i] for i in sorted(left_out)[:MOST_NAMES])])
        more = f" and {len(left_out) - MOST_NAMES} more" if len(left_out) > MOST_NAMES else ""
        text = f"Left out to fit {console.width} characters: {listed}{more}. The CSV file has all columns."
        console.print(Text(text), style="dim")


def _least(name: str, texts: Sequence[str], is_whole: bool) -> int:
    """Return the least width of a column: that of its longest text, or of its longest word if its texts may be wrapped."""
    words = [word for text in texts for word in (text.split("\n") if is_whole else text.split())]
    cells = max(map(cell_len, words), default=0)
    return max(cells if is_whole else min(cells, LONGEST), *map(cell_len, name.split()), 1)
