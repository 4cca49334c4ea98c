"""Writes tables in LaTeX: floats over both columns of a page, no wider than the page, for the package ``booktabs``.

Columns that do not fit continue in a table below. An interval stands in small type below its number.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache

from bench.experiment.views import Table
from bench.report.cells import TableCell, cell, parts
from bench.report.tables import escape_latex

WIDTH = 504.0
"""Text width over two columns in points: 7 inches, which most journals and conferences have at least."""
COLUMN_GAP = 3.0
"""LaTeX's ``tabcolsep`` in points: the space on each side of a column."""
NAME = 150.0
"""Widest column of names in points; longer names are broken into lines."""
LINES = 46
"""Most lines of a float, two per row: they fit one page at footnotesize, with the caption."""
SIGNS = {
    "∞": r"$\infty$",
    "↑": r"$\uparrow$",
    "⧗": r"$\ominus$",
    "†": r"\dag",
    "‡": r"\ddag",
    "–": "--",
    "∅": r"$\emptyset$",
}
"""LaTeX for the signs of failed cells."""


@dataclass(frozen=True)
class Block:
    """A part of a table: its title, the heading and names of its rows, and the headings and cells of its columns."""

    title: str
    head: str
    names: tuple[str, ...]
    columns: tuple[tuple[str, tuple[TableCell, ...]], ...]


def latex(tables: Sequence[Table], experiment: str) -> str:
    """Return tables as floats; the notes of all tables stand in each caption."""
    out = [r"% needs \usepackage{booktabs}; made for a text width of 7 in over both columns, without scaling"]
    notes = " ".join(dict.fromkeys(_text(note) for table in tables for note in table.notes))
    blocks = [part for table in tables for block in _blocks(table) for part in _fitting(block)]
    for i, members in enumerate(_floats(blocks)):
        title = escape_latex(experiment) + (", continued" if i else "")
        out += [r"\begin{table*}[tp]", r"\centering\footnotesize", rf"\setlength{{\tabcolsep}}{{{COLUMN_GAP:g}pt}}"]
        out.append(rf"\caption{{{title}. {notes}}}")
        for block in members:
            out += _tabular(block)
        out.append(r"\end{table*}")
    return "\n".join(out) + "\n"


def _blocks(table: Table) -> Iterable[Block]:
    """Yield the parts of a table; the first column has the names of the rows."""
    first, *rest = table.columns
    for heading, part in parts(table):
        rows = part.to_dict("records")
        columns = tuple((column.heading, tuple(cell(column, row) for row in rows)) for column in rest)
        yield Block(heading or table.title, first.heading, tuple(str(cell(first, row)) for row in rows), columns)


def _text(text: str) -> str:
    for sign in SIGNS:
        text = text.replace(sign, f"\0{sign}")
    return "".join(
        SIGNS[piece[0]] + escape_latex(piece[1:]) if i else escape_latex(piece)
        for i, piece in enumerate(text.split("\0"))
    )


def _tabular(block: Block) -> list[str]:
    long = _name_width(block) > NAME
    names = list(map(escape_latex, block.names))
    if long:
        names = [name.replace(",", r",\allowbreak ").replace(r"\_", r"\_\allowbreak ") for name in names]
    lines = zip(*(map(_in_latex, cells) for _, cells in block.columns), strict=True)
    body = [" & ".join([name, *line]) + r" \\" for name, line in zip(names, lines, strict=True)]
    heads = " & ".join(escape_latex(text) for text in ("", *(head for head, _ in block.columns)))
    title = rf"\parbox{{{WIDTH:g}pt}}{{\centering {escape_latex(block.title)}}}\par\nopagebreak\smallskip"
    return [
        r"\par\medskip", *([title] if block.title else []),
        rf"\begin{{tabular}}{{@{{}}{f'p{{{NAME:g}pt}}' if long else 'l'}{'c' * len(block.columns)}@{{}}}}", r"\toprule",
        heads + r" \\", r"\midrule", *body, r"\bottomrule", r"\end{tabular}\par",
    ]  # fmt: skip


def _in_latex(one: TableCell) -> str:
    note = _text(one.note)
    value = _text(one.value)
    value = (rf"\textbf{{{value}}}" if one.bold else value) + (f" {note}" if len(one.note) > 1 else note)
    return rf"\shortstack{{{value}\\{{\tiny {escape_latex(one.interval)}}}}}" if one.interval else value


def _fitting(block: Block) -> Iterable[Block]:
    """Split a block by columns into blocks that are no wider than the page, or have one column."""
    names = min(NAME, _name_width(block))
    start, used = 0, names
    for end, column in enumerate(block.columns):
        needed = _column_width(*column)
        if end > start and used + needed > WIDTH:
            yield Block(block.title, block.head, block.names, block.columns[start:end])
            start, used = end, names
        used += needed
    if block.columns:
        yield Block(block.title, block.head, block.names, block.columns[start:])


def _floats(blocks: Sequence[Block]) -> list[list[Block]]:
    """Distribute blocks over floats of at most :data:`LINES` lines, in order."""
    floats: list[list[Block]] = []
    used = math.inf
    for block in blocks:
        needed = 4 + 2 * len(block.names)
        if used + needed > LINES:
            floats.append([])
            used = 0.0
        floats[-1].append(block)
        used += needed
    return floats


def width(block: Block) -> float:
    """Return the width of a block in points as set by LaTeX in Computer Modern."""
    return min(NAME, _name_width(block)) + sum(_column_width(*column) for column in block.columns)


def _column_width(head: str, cells: Sequence[TableCell]) -> float:
    texts = [(head, 8.0), *((one.interval, 5.0) for one in cells)]
    # bold characters are wider: factor 1.2 covers the widest bold digits
    texts += ((f"{one.value or 'oo'}{one.note or '?'}", 9.6 if one.bold else 8.0) for one in cells)
    return 2 * COLUMN_GAP + max(_set(text, size) for text, size in texts)


def _name_width(block: Block) -> float:
    return max((_set(name, 8.0) for name in (block.head, *block.names)), default=0.0)


@cache
def _set(text: str, size: float) -> float:
    """Return the width of a string in TeX points, in Computer Modern Roman of ``size`` points."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextToPath

    if not text:
        return 0.0
    plain = "".join(letter if letter.isascii() and letter != "_" else "m" for letter in text).replace("$", "m")
    # digits of the five-point font are up to 1.38 times as wide as digits scaled down from ten points
    stretch = 1.39 if size <= 5 else 1.07
    points = TextToPath().get_text_width_height_descent(plain, FontProperties(family="cmr10", size=size), False)[0]
    return stretch * float(points) * 72.27 / 72
