"""Flattens the parameters of stored rows into typed columns, and identifies the problem of each row.

A row contains its plugins' parameters as JSON. :func:`flatten` turns them into columns once; swept axes, tables, charts
and pages read these columns. Errors and costs may be compared between rows of one **problem**: rows with the same
parameters of some parts of the grid (by default :data:`PROBLEM`) and of the study, and the same theta, see
:func:`problem_columns`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.experiment.defaults import completed_json
from bench.experiment.grid import THETA, applies, is_theta_axis
from bench.model import registry

if TYPE_CHECKING:
    import pandas as pd

PROBLEM = ("scene", "contact", "integrator")
"""The parts of the grid that decide the simulation, and so the gradient that estimates are compared with."""
NOT_PLUGINS = ("study", "theta", "reference")
"""Entries of a row's parameters that are not plugins on an axis of the grid."""


def parse(rows: pd.DataFrame) -> list[Mapping[str, Any]]:
    """Return each row's parameters by axis, with today's defaults for missing ones; empty if the row stores none."""
    return [_parsed(text, registry.folders()) for text in rows["parameters"]]


@lru_cache(maxsize=20_000)
def _parsed(text: str, folders: tuple[Path, ...]) -> Mapping[str, Any]:
    given: Mapping[str, Any] = json.loads(completed_json(text)) if text else {}
    return given


def flatten(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the parameters of rows as typed columns, with the rows' index.

    Columns are ``scene.mass`` for a plugin's parameter, ``scene.name`` for its name, ``theta.names`` for the parameters
    that theta names, and ``theta0.2`` for a coordinate of the point at which gradients are taken. Numbers are float64,
    including infinities; other values are objects. A value is missing if the row's plugin has no such parameter or the
    parameter is null.
    """
    import pandas as pd

    if rows.empty:
        return pd.DataFrame(index=rows.index)
    codes, texts = pd.factorize(rows["parameters"])
    return _flattened(tuple(texts), registry.folders()).take(codes).set_axis(rows.index)


@lru_cache(maxsize=64)
def _flattened(texts: tuple[str, ...], folders: tuple[Path, ...]) -> pd.DataFrame:
    import pandas as pd

    lines = [_flat(_parsed(text, folders)) for text in texts]
    names = dict.fromkeys(name for line in lines for name in line)
    return pd.DataFrame({name: _typed([line.get(name) for line in lines]) for name in names}, index=range(len(lines)))


def _flat(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return one row's parameters by column."""
    line: dict[str, Any] = {}
    for axis, part in given.items():
        for name, value in (part or {}).items():
            if (axis, name) == ("theta", "at"):
                line |= {f"{THETA}.{i}": coordinate for i, coordinate in enumerate(value or ())}
            else:
                line[f"{axis}.{name}"] = tuple(value) if isinstance(value, list) else value
    return line


def _typed(values: Sequence[Any]) -> pd.Series:
    """Return values as float64 if all of them are numbers, infinities (stored as strings) or missing; else as objects."""
    import pandas as pd

    numbers = [as_number(value) for value in values]
    is_number = [value is None or not math.isnan(number) for value, number in zip(values, numbers, strict=True)]
    if all(is_number) and any(value is not None for value in values):
        return pd.Series(numbers, dtype="float64")
    return pd.Series(values, dtype=object)


def as_number(value: Any) -> float:
    """Return a parameter as a float; NaN if it is not a number. Infinities are stored as strings."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return math.nan
    if isinstance(value, str):
        return float(value) if value in ("inf", "-inf") else math.nan
    return float(value)


def swept_columns(name: str, table: pd.DataFrame) -> dict[str, pd.Series]:
    """Return the columns of a flattened ``table`` that a sweep's ``name`` refers to, each with a mask of its rows.

    ``gamma``, ``alpha_order.gamma``, ``estimator.gamma`` and ``estimator.alpha_order.gamma`` name the same parameter.
    ``theta0`` refers to its only coordinate, and to no column in rows where theta has several.
    """

    if is_theta_axis(name):
        column = f"{THETA}.0" if name == THETA else name
        is_single = table[f"{THETA}.1"].isna() if name == THETA and f"{THETA}.1" in table else True
        return {column: table[column].notna() & is_single} if column in table else {}
    parameter = name.rpartition(".")[2]
    columns = {}
    for axis in (column.removesuffix(".name") for column in table if column.endswith(".name")):
        if axis in NOT_PLUGINS or f"{axis}.{parameter}" not in table or parameter == "name":
            continue
        plugins = table[f"{axis}.name"]
        if used := [plugin for plugin in plugins.dropna().unique() if applies(name, axis, plugin, (parameter,))]:
            columns[f"{axis}.{parameter}"] = plugins.isin(used)
    return columns


def problem_columns(
    rows: pd.DataFrame, parts: Collection[str] = PROBLEM, without: Collection[str] = ()
) -> pd.DataFrame:
    """Return the columns that identify the problem of each row: equal rows are the same problem.

    The columns are all parameters of the axes ``parts`` and of the study, and theta, except the swept names ``without``.
    """
    table = flatten(rows)
    wanted = [f"{part}." for part in (*parts, "study", "theta", THETA)]
    problem = table[[column for column in table if column.startswith(tuple(wanted))]]
    for name in without:
        for column, mask in swept_columns(name, table).items():
            if column in problem:
                problem = problem.assign(**{column: problem[column].mask(mask)})
    return problem


def number_problems(rows: pd.DataFrame, parts: Collection[str] = PROBLEM, without: Collection[str] = ()) -> pd.Series:
    """Return the number of each row's problem, counted from 0 in order of appearance; see :func:`problem_columns`."""
    import pandas as pd

    table = problem_columns(rows, parts, without)
    codes = zip(*(pd.factorize(table[column])[0].tolist() for column in table), strict=True)
    numbers: dict[tuple[int, ...], int] = {}
    return pd.Series([numbers.setdefault(code, len(numbers)) for code in codes] or 0, index=rows.index, dtype=int)
