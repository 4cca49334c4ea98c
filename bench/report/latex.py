"""Writes tables in LaTeX: floats over both columns of a page, no wider than the page, for ``booktabs`` and ``graphicx``.

Columns that do not fit continue in a table below. An interval stands in small type below its number.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from bench.experiment.views import Table
from bench.report.cells import TableCell, cell, parts
from bench.report.tables import escape_latex

COLUMNS = 8
"""Most columns beside the names: with intervals they fill the width of two columns of a journal."""
LINES = 46
"""Most lines of a float, two per row: they fit one page at footnotesize, with the caption."""
FIT = r"\resizebox{\ifdim\width>\textwidth\textwidth\else\width\fi}{!}{%"
"""Shrinks a table that is wider than the page."""


def latex(tables: Sequence[Table], experiment: str) -> str:
    """Return tables as floats; the notes of all tables stand in each caption."""
    notes = " ".join(dict.fromkeys(escape_latex(note) for table in tables for note in table.notes))
    floats: list[list[str]] = []
    used = math.inf
    for lines, block in (block for table in tables for block in _blocks(table)):
        if used + lines > LINES:
            floats.append([])
            used = 0
        floats[-1].append(block)
        used += lines
    out = [r"% needs \usepackage{booktabs,graphicx}"]
    for i, blocks in enumerate(floats):
        title = escape_latex(experiment) + (", continued" if i else "")
        out += [r"\begin{table*}[tp]", r"\centering\footnotesize\setlength{\tabcolsep}{3pt}"]
        label = f"tab:{experiment}-{tables[0].name}" + f"-{i + 1}" * bool(i)
        out += [rf"\caption{{{title}. {notes}}}\label{{{label}}}", *blocks, r"\end{table*}"]
    return "\n".join(out) + "\n"


def _blocks(table: Table) -> Iterable[tuple[int, str]]:
    """Yield the parts of a table, each with its number of lines; the first column has the names of the rows."""
    first, *rest = table.columns
    for heading, part in parts(table):
        rows = part.to_dict("records")
        for start in range(0, len(rest), COLUMNS):
            shown = rest[start : start + COLUMNS]
            heads = " & ".join(escape_latex(text) for text in ("", *(column.heading for column in shown)))
            names = [escape_latex(str(cell(first, row))).replace(",", r",\allowbreak ") for row in rows]
            lines = [
                [name, *(_in_latex(cell(column, row)) for column in shown)]
                for name, row in zip(names, rows, strict=True)
            ]
            yield (
                4 + 2 * len(rows),
                "\n".join(
                    [
                        rf"\par\medskip {escape_latex(heading or table.title)}\par\nopagebreak\smallskip",
                        FIT,
                        rf"\begin{{tabular}}{{@{{}}l{'c' * len(shown)}@{{}}}}",
                        r"\toprule",
                        heads + r" \\",
                        r"\midrule",
                        *(" & ".join(line) + r" \\" for line in lines),
                        r"\bottomrule",
                        r"\end{tabular}}\par",
                    ]
                ),
            )


def _in_latex(one: TableCell) -> str:
    note = escape_latex(one.note)
    value = escape_latex(one.value)
    value = (rf"\textbf{{{value}}}" if one.bold else value) + (f" {note}" if len(one.note) > 1 else note)
    return rf"\shortstack{{{value}\\{{\tiny {escape_latex(one.interval)}}}}}" if one.interval else value
