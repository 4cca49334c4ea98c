"""Pivot table for papers: estimators down, values of one swept axis across, within the width of a two-column page.

A cell shows the relative RMSE of one estimate above its 95% interval, or a sign for its failure. Columns beyond the
width continue in a table below. The CSV has every other number of a cell.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from bench.errors import unknown
from bench.experiment.axes import Axis
from bench.experiment.experiment import Experiment
from bench.report.problems import ProblemRows, split_by_problem
from bench.report.tables import escape_latex, escape_markdown
from bench.report.text import axis_value, number
from bench.report.views import Arranged, estimator_curves, rmse_interval
from bench.studies.bias_variance.findings import problems_by_axis

WIDTH = 504.0
"""Text width over two columns in points: 7 inches, which most journals and conferences have at least."""
COLUMN_GAP = 3.0
"""LaTeX's ``tabcolsep`` in points: the space on each side of a column."""
NAME = 150.0
"""Widest column of estimator names in points; longer names are broken into lines."""
LINES = 46
"""Most lines of a LaTeX float, two per estimator: they fit one page at footnotesize, with the caption."""
FAILURES = {
    "nonfinite": ("∞", r"$\infty$", "a result that is not finite"),
    "diverged": ("↑", r"$\uparrow$", "a state that diverged"),
    "timeout": ("⧗", r"$\ominus$", "the time limit"),
    "crashed": ("†", r"\dag", "a process that died"),
    "error": ("‡", r"\ddag", "an error"),
    "unsupported": ("–", "--", "a combination that cannot work"),
    "unavailable": ("∅", r"$\emptyset$", "a library that is not installed"),
}
"""Sign in Markdown, sign in LaTeX and meaning of each status other than ``ok``."""


@dataclass(frozen=True)
class PivotCell:
    """One cell as strings, not yet escaped."""

    value: str = ""
    interval: str = ""
    best: bool = False
    failure: str = ""
    """The status of a cell that is not ok."""
    noted: bool = False
    """Whether its row has a remark."""


@dataclass(frozen=True)
class Block:
    """One problem's table: its title, the axis and its values across, and a row of cells per estimator."""

    title: str
    axis: str
    values: tuple[str, ...]
    rows: tuple[tuple[str, tuple[PivotCell, ...]], ...]


@dataclass(frozen=True)
class Pivot:
    """The pivot table of an experiment: its title and a block per problem."""

    title: str
    blocks: tuple[Block, ...]

    def cells(self) -> Iterator[PivotCell]:
        """Yield every cell."""
        return (cell for block in self.blocks for _, cells in block.rows for cell in cells)


def pivot(experiment: Experiment, shown: Arranged) -> Pivot:
    """Return the pivot table of an experiment, along the axis that ``table.columns`` names, by default the longest.

    Raises an error if ``table.columns`` names no swept axis.
    """
    parts: Sequence[tuple[Axis | None, ProblemRows]] = problems_by_axis(shown)
    if experiment.table.columns:
        axis = _axis(experiment.table.columns, shown)
        parts = [(axis, problem) for problem in split_by_problem(shown, axis)]
    apart = "backend" in experiment.table.rows
    blocks = tuple(_block(axis, problem, apart) for axis, problem in parts)
    return Pivot(f"{experiment.name}: relative RMSE of one estimate", blocks)


def _axis(name: str, shown: Arranged) -> Axis:
    swept = list(shown.swept())
    named = [axis for axis in swept if name in (axis.column, axis.short, *axis.names)]
    if not named:
        raise unknown("column of the table:", name, [axis.column for axis in swept])
    return named[0]


def _block(axis: Axis | None, problem: ProblemRows, apart: bool) -> Block:
    curves = estimator_curves(problem.rows, close=None) if apart else estimator_curves(problem.rows)
    values = sorted({x for line in curves for x in line.at})
    labels = [line.label for line in curves]
    rows = []
    for line in curves:
        # name the backends where an estimator has several rows
        name = f"{line.label} ({', '.join(line.backends)})" if apart or labels.count(line.label) > 1 else line.label
        others = [other for other in curves if other.label != line.label]
        rows.append((name, tuple(_cell(line.at.get(x), [other.at.get(x) for other in others]) for x in values)))
    across = tuple(axis_value(x) for x in values) if axis is not None else ("relative RMSE",)
    return Block(problem.title(), axis.title if axis is not None else "", across, tuple(rows))


def _cell(row: Mapping[str, Any] | None, others: Sequence[Mapping[str, Any] | None]) -> PivotCell:
    if row is None:
        return PivotCell()
    if row["status"] != "ok":
        return PivotCell(failure=str(row["status"]), noted=bool(row["reason"]))
    low, high = rmse_interval(row)
    interval = f"[{number(low)}, {number(high)}]" if math.isfinite(low + high) else ""
    rivals = [rmse_interval(other)[0] for other in others if other is not None and other["status"] == "ok"]
    best = row["rmse_rel"] < 1 and bool(rivals) and all(high < rival for rival in rivals)
    return PivotCell(number(row["rmse_rel"]), interval, best, noted=bool(row["reason"]))


def notes(table: Pivot) -> list[str]:
    """Return the notes below a table: the meaning of its numbers, intervals and bold type, as far as they occur."""
    cells = list(table.cells())
    out = [
        "Relative RMSE: error of one estimate over the norm of the reference gradient; at 1 or above no better than zero."
    ]
    if any(cell.interval for cell in cells):
        out.append("Below it: its 95% interval, from those of bias and variance.")
    if any(cell.best for cell in cells):
        out.append("Bold: lowest, below 1, and its interval apart from that of every other estimator.")
    return out


def markdown(table: Pivot) -> str:
    """Format the table in Markdown, one table per problem."""
    e = escape_markdown
    out = [f"# {e(table.title)}", ""]
    for block in table.blocks:
        if block.title or block.axis:
            out += [f"**{e(block.title)}**" + (f", by {e(block.axis)}" if block.axis else ""), ""]
        out.append("| estimator | " + " | ".join(map(e, block.values)) + " |")
        out.append("|---|" + "--:|" * len(block.values))
        out += [f"| {e(name)} | " + " | ".join(map(_in_markdown, cells)) + " |" for name, cells in block.rows]
        out.append("")
    out += [f"- {e(note)}" for note in notes(table)]
    return "\n".join([*out, *(f"- {sign} {what}" for sign, what in _failures(table, 0))]) + "\n"


def _in_markdown(cell: PivotCell) -> str:
    mark = "?" if cell.noted else ""
    if cell.failure:
        return FAILURES[cell.failure][0] + mark
    value = f"**{cell.value}**" if cell.best else cell.value
    return f"{value}{mark} {escape_markdown(cell.interval)}".strip()


def _failures(table: Pivot, form: int) -> list[tuple[str, str]]:
    """Return the signs of failures and remarks that occur, with meanings; ``form`` is 0 for Markdown, 1 for LaTeX."""
    seen = {cell.failure for cell in table.cells()}
    meanings = [(signs[form], f"{signs[2]}.") for status, signs in FAILURES.items() if status in seen]
    if any(cell.noted and not cell.failure for cell in table.cells()):
        meanings.append(("?", "the row has a remark, so its interval is doubtful: see the column reason of the CSV."))
    return meanings


# ------------------------------------------------------------------------------------------------------- LaTeX


def latex(table: Pivot) -> str:
    """Format the table in LaTeX: floats over both columns, at most :data:`WIDTH` wide; needs only ``booktabs``."""
    out = [r"% needs \usepackage{booktabs}; made for a text width of 7 in over both columns, without scaling"]
    for i, blocks in enumerate(_floats([part for block in table.blocks for part in _fitting(block)])):
        title = escape_latex(table.title) + (", continued" if i else "")
        out += [r"\begin{table*}[tp]", r"\centering\footnotesize", rf"\setlength{{\tabcolsep}}{{{COLUMN_GAP:g}pt}}"]
        out.append(rf"\caption{{{title}. {_legend(table)}}}")
        for block in blocks:
            out += _tabular(block)
        out.append(r"\end{table*}")
    return "\n".join(out) + "\n"


def _legend(table: Pivot) -> str:
    signs = [f"{sign}: {escape_latex(what)}" for sign, what in _failures(table, 1)]
    return " ".join([*map(escape_latex, notes(table)), *signs])


def _tabular(block: Block) -> list[str]:
    title = escape_latex(", by ".join(filter(None, [block.title, block.axis])))
    heads = " & ".join(["", *map(escape_latex, block.values)])
    long = _name_width(block) > NAME
    names = [escape_latex(name) for name, _ in block.rows]
    if long:
        names = [name.replace(",", r",\allowbreak ").replace(r"\_", r"\_\allowbreak ") for name in names]
    body = [
        " & ".join([name, *map(_in_latex, cells)]) + r" \\" for name, (_, cells) in zip(names, block.rows, strict=True)
    ]
    heading = [r"\par\medskip", rf"\parbox{{{WIDTH:g}pt}}{{\centering {title}}}\par\nopagebreak\smallskip"]
    return [
        *(heading if title else [r"\par\medskip"]),
        rf"\begin{{tabular}}{{@{{}}{f'p{{{NAME:g}pt}}' if long else 'l'}{'c' * len(block.values)}@{{}}}}", r"\toprule", heads + r" \\", r"\midrule",
        *body, r"\bottomrule", r"\end{tabular}\par",
    ]  # fmt: skip


def _in_latex(cell: PivotCell) -> str:
    mark = "?" if cell.noted else ""
    if cell.failure:
        return FAILURES[cell.failure][1] + mark
    value = (rf"\textbf{{{cell.value}}}" if cell.best else cell.value) + mark
    return rf"\shortstack{{{value}\\{{\tiny {escape_latex(cell.interval)}}}}}" if cell.interval else value


def _fitting(block: Block) -> list[Block]:
    """Split a block by columns into blocks that are no wider than the page."""
    parts, taken = [], 0
    while taken < len(block.values):
        count = len(block.values) - taken
        while count > 1 and width(_part(block, taken, count)) > WIDTH:
            count -= 1
        parts.append(_part(block, taken, count))
        taken += count
    return parts


def _part(block: Block, start: int, count: int) -> Block:
    rows = tuple((name, cells[start : start + count]) for name, cells in block.rows)
    return Block(block.title, block.axis, block.values[start : start + count], rows)


def _floats(blocks: Sequence[Block]) -> list[list[Block]]:
    """Distribute blocks over floats of at most :data:`LINES` lines, in order."""
    floats: list[list[Block]] = []
    used = math.inf
    for block in blocks:
        needed = 4 + 2 * len(block.rows)
        if used + needed > LINES:
            floats.append([])
            used = 0.0
        floats[-1].append(block)
        used += needed
    return floats


def width(block: Block) -> float:
    """Return the width of a block in points as set by LaTeX in Computer Modern."""
    total = min(NAME, _name_width(block)) + 2 * COLUMN_GAP * len(block.values)
    for i, value in enumerate(block.values):
        cells = [cells[i] for _, cells in block.rows]
        texts = [(value, 8.0), *((cell.interval, 5.0) for cell in cells)]
        # bold characters are wider: factor 1.2 covers the widest bold digits
        texts += ((f"{cell.value or 'oo'}?", 9.6 if cell.best else 8.0) for cell in cells)
        total += max(_set(text, size) for text, size in texts)
    return total


def _name_width(block: Block) -> float:
    return max((_set(name, 8.0) for name, _ in block.rows), default=0.0)


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
