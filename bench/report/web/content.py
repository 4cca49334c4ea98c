"""What a page is made of: a finding, answers, charts and a table, all of the same rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from bench.report.style import MARKERS, PALETTE, VARIANTS
from bench.report.views import axis_text, ran
from bench.store import IDENTITY

SYMBOLS = dict(
    zip(
        MARKERS,
        ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x", "star"),
        strict=True,
    )
)
"""Plotly's names of the charts' markers."""
DASHES = dict(zip(map(str, VARIANTS), ("solid", "dash", "dot"), strict=True))
"""Plotly's names of the charts' line styles."""
DARK = {"#000000": "#ffffff"}
"""Colours that a dark page needs instead; the others are told from both grounds."""


@dataclass(frozen=True)
class Axis:
    """A column that can be an axis: its label, its scale, and the columns of its interval.

    Where the column ``limit`` is not 0 the value is an upper limit.
    """

    column: str
    label: str
    log: bool = True
    low: str = ""
    high: str = ""
    limit: str = ""
    above_one: str = ""
    """What a value above 1 means; the ground there is shaded."""


@dataclass(frozen=True)
class Chart:
    """A chart of a table: points, joined to lines where ``line`` names a column, one panel per value of ``facet``.

    A chart with ``level`` is a map of that column instead; with ``share`` as well, of the share of that level among the
    rows at each place. With ``front`` the points that no other of the same ``front`` beats in x and y are marked.
    """

    title: str
    text: str
    x: Sequence[Axis]
    y: Sequence[Axis]
    table: str = "rows"
    series: str = "series"
    facet: str = ""
    line: str = ""
    front: str = ""
    level: str = ""
    share: str = ""
    marks: dict[str, float] = field(default_factory=dict)
    """Named values of x."""


@dataclass(frozen=True)
class Column:
    """A column of the main table; ``kind`` is text, number, seconds, with ``!`` where ``flag`` is not 0, or limit, with ``<`` there."""

    name: str
    label: str
    kind: str = "number"
    flag: str = ""


@dataclass(frozen=True)
class Content:
    """All that a page shows of a study."""

    finding: str
    rows: pd.DataFrame
    columns: list[Column]
    charts: list[Chart]
    answers: pd.DataFrame = field(default_factory=pd.DataFrame)
    """Texts: what to use where."""
    answers_title: str = "What to use where"
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)
    """Further tables for charts; their column ``row`` is the place in ``rows`` that a line comes from."""
    looks: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Of each value of a chart's ``series`` or ``level``: colour, symbol, dash, letter, meaning."""


def look(
    colour: str, symbol: str = "circle", dash: str = "solid", letter: str = "", meaning: str = ""
) -> dict[str, Any]:
    """How one series is drawn: its colour on light and on dark ground, and its other marks."""
    made = {"colour": [colour, DARK.get(colour, colour)], "symbol": symbol, "dash": dash}
    return made | {name: text for name, text in (("letter", letter), ("meaning", meaning)) if text}


def looks(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colours and symbols in the palette's order."""
    symbols = list(SYMBOLS.values())
    return {
        name: look(PALETTE[i % len(PALETTE)], symbols[(i + i // len(PALETTE)) % len(symbols)])
        for i, name in enumerate(dict.fromkeys(names))
    }


def identity_columns(rows: pd.DataFrame) -> list[Column]:
    """The identity columns that vary."""
    varying = [name for name in IDENTITY if rows[name].nunique(dropna=False) > 1] or ["scene", "estimator"]
    texts = {name for name in varying if not pd.api.types.is_numeric_dtype(rows[name])}
    return [Column(name, name.replace("_", " "), "text" if name in texts else "number") for name in varying]


STATUS = [Column("status", "status", "text"), Column("reason", "reason", "text")]
"""What every main table ends with."""


def numeric_axis(name: str) -> Axis:
    """The axis of a swept parameter."""
    return Axis("x", axis_text(name))


def titled(rows: pd.DataFrame, names: Sequence[str]) -> pd.Series:
    """Of each row the values of some text columns, joined by commas; ``none`` and nothing are left out."""
    return pd.Series(
        [", ".join(text for text in map(str, row) if text not in ("", "none")) for row in rows[list(names)].to_numpy()],
        index=rows.index,
        dtype=object,
    )


def counted(count: int, one: str, many: str = "") -> str:
    """``1 cell``, ``3 cells``."""
    return f"{count} {one if count == 1 else many or one + 's'}"


def nothing_ran(rows: pd.DataFrame) -> str:
    """What to say where there is no result at all; nothing where there is one."""
    tried = ran(rows)
    if (tried["status"] == "ok").any():
        return ""
    return "No cell gave a result: the table has the reason of each."


def finite(value: float) -> bool:
    """Whether a value is a number at all."""
    return isinstance(value, int | float) and math.isfinite(value)
