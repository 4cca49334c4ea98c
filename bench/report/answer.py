"""Fills in answers: texts by a person, whose numbers are references to the tables of an experiment.

A reference is ``{table | filters | column | format}``. ``{verdicts | method=fobg, at<=3000 | error < 1}`` gives
``0.10 to 0.15``, and an error where a selected value is not below 1. Further conditions on the selected rows follow the
column: ``error, verdict=works``. Values with a comma stand in double quotes. The format is a key of :data:`FORMATS`, by
default ``number``.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from bench.errors import UserError, unknown
from bench.report.problems import value_text
from bench.report.text import duration, interval, listed, number

REFERENCE = re.compile(r"\{([^{}]*)\}")
CONDITION = re.compile(r'\s*([^,=<>!]+?)\s*(<=|>=|!=|=|<|>)\s*("[^"]*"|[^,]*)\s*(?:,|$)')
OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "=": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}


def fill(text: str, table: Callable[[str], pd.DataFrame]) -> str:
    """Return a text with the value of each reference; ``table`` returns a table by its name.

    Raises :class:`LookupError` if a reference selects nothing, or if the selected values do not meet its condition.
    """
    return REFERENCE.sub(lambda match: value_of(match[1], table), text)


def value_of(reference: str, table: Callable[[str], pd.DataFrame]) -> str:
    """Return the value of one reference, without its braces, as text."""
    name, filters, column, *form = (part.strip() for part in reference.split("|"))
    rows = select(table(name), filters)
    shown, _, rest = column.partition(",")
    column = own[1] if (own := CONDITION.fullmatch(shown)) else shown
    for condition in filter(None, (own, *CONDITION.finditer(rest))):
        holds = _holds(rows, condition)
        if not holds.all():
            wrong = rows.loc[~holds, condition[1]].unique()[:3]
            raise LookupError(f"{{{reference}}}: {condition[1]} is {listed(map(str, wrong))}")
    if column not in rows:
        raise unknown("column", column, rows.columns)
    chosen = (form or ["number"])[0]
    if chosen not in FORMATS:
        raise unknown("format", chosen, FORMATS)
    return FORMATS[chosen](rows, column)


def select(rows: pd.DataFrame, filters: str) -> pd.DataFrame:
    """Return the rows that meet all filters, ``estimator=fobg, stiffness<=3e3``; raises :class:`LookupError` if none does."""
    conditions = [*CONDITION.finditer(filters)]
    if "".join(condition[0] for condition in conditions) != filters:
        raise UserError(f"'{filters}' is not a filter: write column=value, with quotes around a value with commas")
    for condition in conditions:
        rows = rows[_holds(rows, condition)]
    if rows.empty:
        raise LookupError(f"no rows with {filters}")
    return rows


def _holds(rows: pd.DataFrame, condition: re.Match[str]) -> Any:
    """Return a mask of the rows that meet a condition."""
    name, sign, value = condition[1], condition[2], condition[3].strip('"')
    if name not in rows:
        raise unknown("column", name, rows.columns)
    values = rows[name]
    if pd.api.types.is_numeric_dtype(values) and values.dtype != bool:
        return OPERATORS[sign](values, float(value))
    return OPERATORS[sign](values.fillna("").astype(str), value)


def _finite(rows: pd.DataFrame, column: str) -> np.ndarray:
    values: np.ndarray = rows[column].to_numpy(float)
    if not np.isfinite(values).all():
        raise LookupError(f"{column} is not finite")
    return values


def _interval(rows: pd.DataFrame, column: str) -> str:
    value, *ends = _only(rows, column)
    return f"{number(value, 3)} [{', '.join(number(end, 3) if np.isfinite(end) else 'no limit' for end in ends)}]"


def _only(rows: pd.DataFrame, column: str) -> tuple[float, float, float]:
    """Return the value and the interval of the only row."""
    if len(rows) != 1:
        raise LookupError(f"{column}: an interval belongs to one row, and {len(rows)} are selected")
    value, low, high = (float(rows[f"{column}{end}"].iloc[0]) for end in ("", "_low", "_high"))
    return value, low, high


def _percents(rows: pd.DataFrame, column: str) -> str:
    value, low, high = _only(rows, column)
    return f"{value:.0%} [{low:.0%}, {high:.0%}]"


def _ends(text: Callable[[float], str]) -> Callable[[pd.DataFrame, str], str]:
    """Return the function that formats the least and the largest value, or one of them where both print the same."""
    return lambda rows, column: " to ".join(dict.fromkeys(map(text, np.sort(_finite(rows, column))[[0, -1]])))


FORMATS: dict[str, Callable[[pd.DataFrame, str], str]] = {
    "number": _ends(number),
    "percent": _ends(lambda value: f"{number(100.0 * value)}%"),
    "integer": _ends("{:,.0f}".format),
    "seconds": _ends(duration),
    "least": lambda rows, column: number(_finite(rows, column).min()),
    "most": lambda rows, column: number(_finite(rows, column).max()),
    "interval": _interval,
    "ratio": lambda rows, column: interval(*_only(rows, column)),
    "percent interval": _percents,
    "names": lambda rows, column: listed(dict.fromkeys(map(value_text, rows[column]))),
    "rows": lambda rows, column: f"{len(rows):,}",
}
"""Formats by name: ranges of numbers, one end of them, an interval of one row, the values, or the number of rows."""
