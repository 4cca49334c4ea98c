"""Returns the cells of a page as data for its script: by column, with filters and the commands that run them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pandas as pd

from bench.experiment.columns import IDENTITY, Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Views
from bench.report import reproduce
from bench.report.generic import own_columns
from bench.report.problems import varying_identity
from bench.report.views import arrange, unsteady

MOST = 24
"""Largest number of distinct values of a column that is offered as a filter."""
IN_SIGHT, FIRST = 5, 3
"""Most identity and result columns before the status, which a laptop then shows without scrolling."""


def page_data(
    experiment: Experiment, rows: pd.DataFrame, views: Views, commands: Sequence[Sequence[str]]
) -> dict[str, Any]:
    """Return the data of an experiment's page. ``commands`` are the words that run each row's cell."""
    arranged = arrange(experiment, rows.reset_index(drop=True))
    swept = [axis.column for axis in arranged.axes]
    cells = (arranged.rows if views.rows is None else views.rows).reset_index(drop=True)
    cells = cells.assign(**{name: arranged.rows[name].to_numpy() for name in swept if name not in cells})
    if "time_s" in cells:
        cells = cells.assign(unsteady=unsteady(cells).astype(float))
    return cells_data(cells, views.columns or own_columns(experiment, cells), swept, commands)


def cells_data(
    cells: pd.DataFrame, own: Sequence[Column], swept: Sequence[str] = (), commands: Sequence[Sequence[str]] = ()
) -> dict[str, Any]:
    """Return cells as data: identity and swept columns, the columns ``own``, ``status`` and ``reason``."""
    columns = _columns(own, cells, swept)
    filters = _filters(cells, columns, swept)
    identity = [name for name in dict.fromkeys((*IDENTITY, *swept)) if name in cells]
    flags = {column["flag"] for column in columns}
    names = {"reason", "status", *identity, *filters, *(column["name"] for column in columns), *flags}
    cells = cells.astype({name: float for name in flags if name in cells})
    longest = max(map(len, commands), default=0)
    words = [[line[i] if i < len(line) else "" for line in commands] for i in range(longest)]
    return {
        "count": len(cells),
        "statuses": cells["status"].value_counts().to_dict(),
        "cells": {name: encode(cells[name]) for name in cells if name in names},
        "columns": columns,
        "filters": filters,
        "identity": identity,
        "command": {"head": reproduce.HEAD, "words": [encode(pd.Series(part, dtype=object)) for part in words]},
    }


def _columns(own: Sequence[Column], cells: pd.DataFrame, swept: Sequence[str]) -> list[dict[str, str]]:
    """Return the columns of the table of cells: identity, the first results, status, the other results, the reason.

    A column is of kind text, number or seconds. Where the column ``flag`` is not 0, seconds are marked with ``!`` and numbers,
    which are limits, with ``<``.
    """
    identity = [
        Column(
            name, label=name.replace("_", " "), kind="number" if pd.api.types.is_numeric_dtype(cells[name]) else "text"
        )
        for name in varying_identity(cells, swept)
    ]
    status, reason = map(text, ("status", "reason"))
    order = [*identity[:IN_SIGHT], *own[:FIRST], status, *own[FIRST:], *identity[IN_SIGHT:], reason]
    flags = {"time_s": "unsteady"} if "unsteady" in cells else {}
    return [
        {
            "name": c.name,
            "label": c.heading,
            "kind": "seconds" if c.format == "seconds" else c.kind,
            "flag": c.limit or flags.get(c.name, ""),
        }
        for c in order
    ]


def _filters(cells: pd.DataFrame, columns: Sequence[dict[str, str]], swept: Sequence[str]) -> list[str]:
    """Return the columns to filter by: cell identity, swept parameters and verdicts of the table, where they vary.

    Columns with more than :data:`MOST` values and the column ``reason`` are omitted.
    """
    texts = [column["name"] for column in columns if column["kind"] == "text" and column["name"] != "reason"]
    names = dict.fromkeys((*IDENTITY, *swept, *texts, "experiment", "status"))
    return [name for name in names if name in cells and 1 < cells[name].nunique(dropna=False) <= MOST]


def encode(values: pd.Series) -> Any:
    """Encode a column for JSON: numbers rounded, None where missing; texts as distinct values and an index."""
    if pd.api.types.is_bool_dtype(values) or not pd.api.types.is_numeric_dtype(values):
        codes, unique = pd.factorize(values.astype(str))
        return {"values": list(unique), "index": codes.tolist()}
    codes, unique = pd.factorize(values)
    if 2 * len(unique) > len(values):
        return [_short(value) for value in values.tolist()]
    short = [*map(_short, unique.tolist()), None]  # the code of a missing number is -1, the last place
    return [short[code] for code in codes.tolist()]


def _short(value: float) -> float | int | None:
    if value is None or not math.isfinite(value):
        return None
    value = float(f"{value:.6g}")
    return int(value) if value.is_integer() and abs(value) < 1e15 else value
