"""Prints a table on the terminal, never wider than the terminal."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np
import pandas as pd
from rich.cells import cell_len, chop_cells
from rich.console import Console

from bench.report.labels import LONGEST, Labels
from bench.report.text import number, one_line

GAP = 2
"""Blanks between two columns."""
LEAST_WIDTH = 20
"""Least width of a table in characters, where the terminal states less."""
LEAST_TEXT = 14
"""Width to which a column of text is wrapped before a column is left out, in characters."""
MOST_NAMES = 24
"""Most names of columns that are listed as left out."""
KEPT = ("status",)
"""Columns that are left out last, after the first column."""


def open_console() -> Console:
    """Return a console that prints names as they are, without markup. It is as wide as the terminal.

    ``COLUMNS`` replaces the width of the terminal, in a pipe too. A pipe without a terminal has 80 columns.
    """
    return Console(highlight=False, markup=False, emoji=False)


@dataclass(frozen=True)
class Layout:
    """A table as lines of text, each at most as wide as requested."""

    title: list[str]
    header: list[str]
    body: list[str]
    notes: list[str]

    def __str__(self) -> str:
        return "\n".join([*self.title, *self.header, *self.body, *self.notes])


def print_table(
    console: Console,
    table: pd.DataFrame,
    title: str = "",
    notes: Sequence[str] = (),
    heads: Mapping[str, str] = MappingProxyType({}),
    right: Collection[str] = (),
    least_important: Sequence[str] = (),
) -> None:
    """Print a table as wide as the console at most; see :func:`layout` for the arguments."""
    lines = layout(table, console.width, title, notes, heads, right, least_important)
    for part, style in ((lines.title, "bold"), (lines.header, "underline"), (lines.body, ""), (lines.notes, "dim")):
        for line in part:
            console.print(
                line,
                style=style,
                no_wrap=True,
                overflow="ignore",
                crop=False,
                markup=False,
                highlight=False,
                emoji=False,
            )


def layout(
    table: pd.DataFrame,
    width: int,
    title: str = "",
    notes: Sequence[str] = (),
    heads: Mapping[str, str] = MappingProxyType({}),
    right: Collection[str] = (),
    least_important: Sequence[str] = (),
) -> Layout:
    """Lay out a table of strings or numbers in lines of ``width`` characters at most.

    ``heads`` replaces names of columns. Columns of numbers and the columns ``right`` are right-aligned and never
    wrapped. Long identity strings have short labels, explained below the table. Where the table is too wide, columns
    with one value are stated once above it, then text wraps, then columns are left out and named below it: first
    ``least_important`` in their order, then from the right. The first column and the status stay longest.
    """
    width = max(width, LEAST_WIDTH)
    labels = Labels()
    given = [str(name) for name in table]
    keys = [name if given.count(name) == 1 else f"{name} {place}" for place, name in enumerate(given)]
    table = table.set_axis(keys, axis=1)
    numeric = {name for name in table if pd.api.types.is_numeric_dtype(table[name]) and table[name].dtype != bool}
    aligned = {key for key, name in zip(keys, given, strict=True) if key in numeric or name in right}
    columns = {name: [_text(value, name in numeric, labels) for value in table[name]] for name in keys}
    names = {key: heads.get(name, name) for key, name in zip(keys, given, strict=True)}

    @cache
    def least(name: str) -> int:
        natural = _widest(columns[name])
        if name not in aligned:
            longest = _widest(piece for text in columns[name] for piece in _pieces(text))
            natural = min(natural, max(LEAST_TEXT, min(longest, LONGEST)))
        return max(natural, _widest(_pieces(names[name])))

    def total(visible: Sequence[str]) -> int:
        return sum(map(least, visible)) + GAP * (len(visible) - 1)

    visible = list(columns)
    constant: list[str] = []
    if total(visible) > width and len(table) > 1:
        constant = [name for name in visible[1:] if len(set(columns[name])) == 1]
        visible = [name for name in visible if name not in constant]
    first_out = [name for name in least_important if name in visible[1:]]
    others = [name for name in reversed(visible[1:]) if name not in first_out]
    queue = [*first_out, *sorted(others, key=lambda name: name in KEPT)]
    kept, used = set(visible), total(visible)
    omitted: list[str] = []
    for name in queue:
        if used <= width:
            break
        omitted.append(name)
        kept.remove(name)
        used -= least(name) + GAP
    for name in reversed(omitted):  # a narrow column may fit where a wide one did not
        if used + least(name) + GAP <= width:
            kept.add(name)
            used += least(name) + GAP
    visible = [name for name in columns if name in kept]
    widths = _widths([(least(name), _widest([names[name], *columns[name]])) for name in visible], width)

    def lines(cells: Sequence[str]) -> list[str]:
        wrapped = [wrap(cell, size) for cell, size in zip(cells, widths, strict=True)]
        height = max(map(len, wrapped), default=0)
        return [
            (" " * GAP)
            .join(
                _padded(part[row] if row < len(part) else "", size, name in aligned)
                for part, size, name in zip(wrapped, widths, visible, strict=True)
            )
            .rstrip()
            for row in range(height)
        ]

    facts = [f"{names[name]}: {columns[name][0]}" for name in constant if columns[name][0]]
    dropped = [names[name] for name in columns if name not in kept and name not in constant]
    remarks = [*labels.key, *notes]
    if dropped:
        more = f" and {len(dropped) - MOST_NAMES} more" if len(dropped) > MOST_NAMES else ""
        left_out = ", ".join(dropped[:MOST_NAMES]) + more
        remarks.append(f"Left out to fit {width} characters: {left_out}. The CSV file has all columns.")
    return Layout(
        title=_wrapped([*title.splitlines(), *(["; ".join(facts)] if facts else [])], width),
        header=lines([names[name] for name in visible]),
        body=[line for row in zip(*(columns[name] for name in visible), strict=True) for line in lines(row)],
        notes=_wrapped(remarks, width),
    )


def wrap(text: str, width: int) -> list[str]:
    """Return text in lines of ``width`` characters at most, broken after blanks and commas where possible."""
    result: list[str] = []
    for line in text.split("\n"):
        current = ""
        for piece in _pieces(line):
            if cell_len((current + piece).rstrip()) <= width:
                current += piece
                continue
            if current:
                result.append(current.rstrip())
            *full, current = chop_cells(piece, width) or [""]
            result += full
        result.append(current.rstrip())
    return result


def _text(value: object, is_number: bool, labels: Labels) -> str:
    if is_number and not isinstance(value, int | np.integer):
        return number(float(value), 3)  # type: ignore[arg-type]
    if pd.api.types.is_scalar(value) and pd.isna(value):
        return ""
    return "\n".join(labels.short(one_line(line)) for line in str(value).split("\n"))


def _pieces(line: str) -> list[str]:
    """Return the parts of a line between which it may be broken."""
    return [piece for piece in re.split(r"(?<=[,\s])", line) if piece]


def _wrapped(lines: Iterable[str], width: int) -> list[str]:
    return [part for line in lines for part in wrap(line, width)]


def _widest(texts: Iterable[str]) -> int:
    return max((cell_len(line.rstrip()) for text in texts for line in text.split("\n")), default=0)


def _widths(bounds: Sequence[tuple[int, int]], width: int) -> list[int]:
    """Return the columns' widths between least and natural width, the free characters going to the narrowest needs."""
    widths = [min(least, width) for least, _ in bounds]
    free = width - sum(widths) - GAP * (len(bounds) - 1)
    for rank, index in enumerate(sorted(range(len(bounds)), key=lambda i: bounds[i][1] - widths[i])):
        share = free // (len(bounds) - rank)
        extra = max(0, min(bounds[index][1] - widths[index], share))
        widths[index] += extra
        free -= extra
    return widths


def _padded(text: str, width: int, is_right: bool) -> str:
    blanks = " " * (width - cell_len(text))
    return blanks + text if is_right else text + blanks
