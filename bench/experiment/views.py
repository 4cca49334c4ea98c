"""What a study shows of its rows, as data: tables and charts. :mod:`bench.report` writes and draws them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from bench.experiment.columns import Column

if TYPE_CHECKING:
    import pandas as pd

ChartKind = Literal["lines", "points", "dots", "grid"]


@dataclass(frozen=True)
class Style:
    """The look of one series or level."""

    colour: str
    marker: str = "o"
    """A Matplotlib marker; empty for a line without markers."""
    line: Any = "-"
    """A Matplotlib line style; ``none`` for points without a line, each with its marker."""
    meaning: str = ""
    """What the name stands for, in legends."""
    width: float = 1.3
    """Line width in points."""


@dataclass(frozen=True)
class Mark:
    """A named value of an axis, drawn as a line, or a named range, drawn as a shaded band."""

    name: str
    at: float
    to: float | None = None
    """The end of the range; infinity for the rest of the axis."""
    axis: Literal["x", "y"] = "x"
    panel: str | None = None
    """The only panel that has the mark; None for all panels."""


@dataclass(frozen=True)
class Chart:
    """A chart as data: which columns of a table are drawn against each other, for files and page.

    - ``lines``: y against x, a line per ``series``, 95% intervals where the columns have them.
    - ``points``: the same without lines.
    - ``dots``: a row per value of the text column y, and x with its interval; ``join`` connects the dots of a row.
    - ``grid``: a cell per pair of x and y, coloured by the text column ``level``, with the text of the
      column ``cell``.
    """

    name: str
    """The stem of the files' names."""
    frame: pd.DataFrame
    """A line per point."""
    x: Sequence[Column]
    """The horizontal quantities: the first is drawn, ``*.plotted.csv`` has all."""
    y: Sequence[Column]
    kind: ChartKind = "lines"
    title: str = ""
    """What the chart answers; in the file of an experiment's main chart that is the experiment's question."""
    series: str = ""
    """The column whose values have a colour and a marker each."""
    line: str = ""
    """The column that separates lines of the same series, such as backends; by default ``series``."""
    panel: str = ""
    """The column with a panel per value."""
    level: str = ""
    cell: str = ""
    limit: str = ""
    """The column with a value of y per x, drawn as a line on a ``grid``, and named ``limit_name``."""
    limit_name: str = ""
    subtitle: str = ""
    """Conditions that all panels share, and how to read them."""
    panel_notes: Mapping[str, str] = field(default_factory=dict)
    """Words below the title of a panel, such as a verdict, by panel."""
    styles: Mapping[str, Style] = field(default_factory=dict)
    """The looks of series or levels; others get a colour each."""
    marks: Sequence[Mark] = ()
    join: bool = False
    arrow: str = ""
    """The column whose values are one or two points each: ``points`` joins two by an arrow, named ``arrow_name``."""
    arrow_name: str = ""
    failed: str = ""
    """The column that is true where a point has no value: a cross at the upper edge, or at the lower one for 0, named ``failed_name`` like a blank cell."""
    failed_name: str = "no result"
    across: int = 4
    """Most panels side by side."""
    height: float = 2.3
    """Height of a panel of ``lines`` or ``points`` in inches."""
    steps: bool = False
    """Whether lines are steps: each value holds up to the next one."""
    band: bool = False
    """Whether intervals are drawn as bands and not as bars."""
    own_scales: bool = False
    """Whether each panel has its own scale of x, for dots. Plots then share that of x, and each quantity of ``y`` has a row of
    panels with one scale, or with ``across=1`` each panel its own."""

    def __post_init__(self) -> None:
        if missing := sorted(set(self._names()) - set(self.frame)):
            raise ValueError(f"chart {self.name}: its table has no column {', '.join(missing)}")

    def plotted(self) -> pd.DataFrame:
        """Return the drawn columns: panel, series, levels, and all quantities with their intervals."""
        return self.frame[self._names()]

    def _names(self) -> list[str]:
        """Return the columns of the table that the chart needs."""
        axes = [name for c in (*self.x, *self.y) for name in (c.name, c.low, c.high, c.limit)]
        names = [self.panel, self.series, self.line, self.level, self.cell, self.failed, self.arrow, self.limit, *axes]
        return [name for name in dict.fromkeys(names) if name]


@dataclass(frozen=True)
class Table:
    """A table for readers and for programs."""

    name: str
    """The stem of the files' names."""
    frame: pd.DataFrame
    """A line per entry, numbers with all digits. Columns that ``columns`` does not name are only in the CSV."""
    columns: Sequence[Column] = ()
    """The columns for readers, in order; without any the table is for programs only, a CSV."""
    title: str = ""
    notes: Sequence[str] = ()
    """Paragraphs below the table."""
    files: Sequence[Literal["csv", "md", "tex"]] = ("csv", "md")
    terminal: bool = False
    """Whether the terminal shows the table."""
    details: Sequence[str] = ()
    """Columns for readers that the terminal omits."""
    page: bool = False
    """Whether the page shows the table, above the charts, if no table before has this too."""
    split: str = ""
    """The column that divides the table for readers into parts with a heading each."""
    data: pd.DataFrame | None = None
    """The table for programs, the CSV, if it is not ``frame``; see :func:`bench.experiment.axes.table`."""


@dataclass(frozen=True)
class Views:
    """All that a study shows of its rows."""

    tables: Sequence[Table] = ()
    charts: Sequence[Chart] = ()
    """The main chart first."""
    rows: pd.DataFrame | None = None
    """The rows with further columns, such as the names of series: the cells on the page; None: the rows as stored."""
    columns: Sequence[Column] = ()
    """The result columns of the page's table of cells; empty: all of the study's numbers and verdicts."""
    remarks: Sequence[str] = ()
    """Lines that the terminal adds, such as the reasons of cells without results."""
    headline: str = ""
    """What stands first and last: the experiment's answer, which :mod:`bench.report` fills in, else the study's own count."""
