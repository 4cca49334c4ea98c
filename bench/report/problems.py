"""Splits rows by problem, and names each problem by the columns that distinguish it from the others.

:mod:`bench.experiment.parameters` defines problems. This module selects their rows and formats their parameters.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from bench.experiment.axes import Axis, smoothing_of
from bench.experiment.columns import IDENTITY
from bench.experiment.parameters import PROBLEM, number_problems
from bench.report.text import axis_value
from bench.report.views import CATEGORIES, RUN, Arranged, rows_along


@dataclass(frozen=True, eq=False)
class ProblemRows:
    """The rows of one problem along an axis, and the names and values that distinguish it from the other problems."""

    identity: Mapping[str, Any]
    rows: pd.DataFrame

    def parts(self) -> tuple[str, dict[str, Any]]:
        """Return the texts of the identity as a string, and its numbers by name."""
        numbers = {name: value for name, value in self.identity.items() if not isinstance(value, str)}
        return joined({**self.identity, **dict.fromkeys(numbers, "")}), numbers

    def title(self) -> str:
        """Return the problem as a string: ``pushing, penalty, sigma=0.1``."""
        return joined(self.identity)


def joined(values: Mapping[Any, Any]) -> str:
    """Return ``pushing, sigma=0.1``: texts as they are, numbers with their names; not what is empty, ``none`` or missing."""
    texts = (
        value if isinstance(value, str) else f"{name}={axis_value(value)}" if math.isfinite(value) else ""
        for name, value in values.items()
    )
    return ", ".join(text for text in texts if text not in ("", "none"))


def split_by_problem(shown: Arranged, axis: Axis | None, always: Sequence[str] = ()) -> list[ProblemRows]:
    """Split the rows along an axis into problems, in order of appearance. Names always contain the columns ``always``.

    A swept quantity distinguishes problems if it varies at a fixed value ``x`` of the axis. A quantity that steps with
    the axis, as in a ``zip``, does not. Sample counts, repeats and parameters of estimators count as swept quantities
    here.
    """
    table = rows_along(shown, axis)
    if table.empty:
        return []
    quantities = shown.numbers
    n_values = table.groupby([*CATEGORIES, *RUN, "x"], dropna=False)[quantities].nunique(dropna=False).max()
    columns = [*CATEGORIES, *(name for name in quantities if n_values[name] > 1)]
    moving = [other for other in shown.axes if other.column not in columns]
    numbers = problem_numbers(table, PROBLEM, [*moving, *([axis] if axis is not None else [])])
    varying = [table[name] for name in columns if name in quantities]
    groups = table.groupby([numbers, *varying], dropna=False, sort=False).ngroup()
    named = distinguishing_columns(table, groups, columns, always) or ["scene", "contact"]
    result = []
    for _, part in table.groupby(groups, sort=False):
        first = part.iloc[0]
        labels = {"smoothing": smoothing_of(first["contact"].partition("[")[0]) or "smoothing"}
        named_values = {name: value for name, value in first[named].items() if joined({name: value})}
        identity = {
            labels.get(name, name): value for name, value in named_values.items() if (name, value) != ("horizon", 0)
        }
        result.append(ProblemRows(identity, part.reset_index(drop=True)))
    return result


def problem_numbers(rows: pd.DataFrame, parts: Sequence[str], without: Sequence[Axis] = ()) -> pd.Series:
    """Return the number of each row's problem, ignoring the axes ``without``; see :func:`~.parameters.number_problems`."""
    return number_problems(rows, parts, [name for axis in without for name in axis.names])


def constants(rows: pd.DataFrame, groups: pd.Series, names: Sequence[str]) -> pd.DataFrame:
    """Return a line per group, in order of appearance, with the values of some columns; empty where the rows differ."""
    parts = rows[list(names)].groupby(groups, sort=False)
    values = parts.first().reindex(groups.unique()).astype(object)
    return values.mask(parts.nunique(dropna=False).reindex(values.index) > 1, "")


def distinguishing_columns(
    rows: pd.DataFrame, groups: pd.Series, names: Iterable[Any], always: Sequence[Any]
) -> list[Any]:
    """Return the columns, of ``names``, that distinguish the groups, and the columns ``always``.

    A column is added only if the columns before it do not distinguish all groups that it does.
    """
    names = [name for name in names if name in rows]
    values = constants(rows, groups, names).astype(str)

    choice: list[str] = []
    count = min(1, len(values))
    for name in names:
        more = len(values[[*choice, name]].drop_duplicates())
        if name in always or more > count:
            choice.append(name)
            count = more
    return choice


def varying_identity(rows: pd.DataFrame, swept: Sequence[str] = ()) -> list[str]:
    """Return the identity and swept columns that vary; scene and estimator if none does and there are any."""
    names = [name for name in dict.fromkeys((*IDENTITY, *swept)) if name in rows]
    varying = [name for name in names if rows[name].nunique(dropna=False) > 1]
    return varying or [name for name in ("scene", "estimator") if name in names]


def problem_names(
    shown: Arranged,
    parts: Sequence[str],
    without: Sequence[Axis] = (),
    always: Sequence[str] = ("scene",),
    rows: pd.DataFrame | None = None,
) -> pd.Series:
    """Return the name of each row's problem, ``mass_spring, damping=0``, unique among problems that differ in ``parts``.

    The axes ``without`` are ignored. ``always`` are columns to name even if they distinguish nothing. ``rows`` are some
    rows of ``shown``, by default all.
    """
    rows = shown.rows if rows is None else rows
    groups = problem_numbers(rows, parts, without)
    columns = label_columns(shown, parts, without, always, rows)
    names: dict[Any, str] = {}
    for group, line in constants(rows, groups, columns).iterrows():
        name = joined(line.to_dict())
        names[group] = name if name not in names.values() else f"{name} ({group})"
    return groups.map(names).astype(object)


def label_columns(
    shown: Arranged,
    parts: Sequence[str],
    without: Sequence[Axis] = (),
    always: Sequence[str] = ("scene", "contact"),
    rows: pd.DataFrame | None = None,
) -> list[str]:
    """Return the columns that distinguish rows with different ``parts``, with the arguments of :func:`problem_names`."""
    rows = shown.rows if rows is None else rows
    more = {"backend": ["dtype"], "estimator": ["estimator_params"], "scene": ["noise"]}
    labels = [*parts, *(name for part in parts for name in more.get(part, []))]
    names = [name for name in (*labels, *shown.numbers) if name not in {axis.column for axis in without}]
    return distinguishing_columns(rows, problem_numbers(rows, parts, without), names, always)


def value_text(value: Any) -> str:
    """Return a value of an identity column, string or number, as a string."""
    return value if isinstance(value, str) else axis_value(value)


def titled(rows: pd.DataFrame, names: Sequence[str]) -> pd.Series:
    """Return, per row, the values of some columns as :func:`joined` gives them."""
    return pd.Series([*map(joined, rows[list(names)].to_dict("records"))], index=rows.index, dtype=object)


def axes_of(shown: Arranged, *columns: str) -> list[Axis]:
    """Return the axes whose values are in some columns, under any name, and the axes that step with them."""

    def has_values_of(axis: Axis) -> bool:
        known = shown.rows[axis.column].notna()
        return bool((shown.rows.loc[known, axis.short] == shown.rows.loc[known, axis.column]).all())

    own = [a for a in shown.axes if a.column in columns or (a.short in columns and has_values_of(a))]
    moving = {name for axis in own for name in axis.moves}
    return [axis for axis in shown.axes if axis in own or axis.column in moving]
