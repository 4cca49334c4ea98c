"""Compares two results cell by cell: pairs the rows of the same cell and judges each pair."""

from __future__ import annotations

import json
import math
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import pandas as pd

from bench.compare import timings
from bench.compare.judging import Change, Row, judge_cell, rule_of
from bench.experiment.columns import IDENTITY, Column, Columns
from bench.experiment.parameters import completed

OUTCOMES = ("worse", "better", "changed", "same")
COUNTS = ("samples", "repeats", "seed")
"""Columns that identify a cell, besides the parameters of its plugins."""
FIRST = ("outcome", "change", *IDENTITY, "status_before", "status_after")
"""The first columns of a comparison. The columns of :func:`both_sides` follow, then :data:`LAST`."""
LAST = ("parameters",)
WORSE_IN = "worse_in"
"""Internal column, not written to files: the list of :attr:`Change.subject` of the changes for the worse."""

Key = tuple[str, ...]


def both_sides(columns: Sequence[Column]) -> list[str]:
    """Return the names of judged columns on both sides: ``bias_before``, ``bias_after``."""
    return [f"{column.name}_{when}" for column in columns for when in ("before", "after")]


def compare_cells(
    before: pd.DataFrame, after: pd.DataFrame, columns: Columns, again: Sequence[pd.DataFrame] = ()
) -> tuple[pd.DataFrame, list[str]]:
    """Return one line per cell of either side, with its identity and outcome, and remarks on times.

    Two rows are of one cell if all their parameters, samples, repeats and seed are equal. A parameter that a stored row
    lacks has its present default. With ``again``, further runs of before, which show the spread between runs, times are
    judged too.
    """
    judged = columns.compared
    old, new, *more = (rows_by_cell(rows) for rows in (before, after, *again))
    changes = {key: judge_cell(judged, old.get(key), new.get(key)) for key in dict.fromkeys([*old, *new])}
    remarks: list[str] = []
    for column in judged if again else ():
        if rule_of(column).by == "time":
            was, now, *runs = (_succeeded(rows) for rows in (old, new, *more))
            of_column, of_times = timings.judge_times(column.name, rule_of(column).called, was, now, runs)
            remarks += of_times
            for key, change in of_column.items():
                changes[key].append(change)  # type: ignore[index]
    lines = [_line(old.get(key), new.get(key), judged, own) for key, own in changes.items()]
    return pd.DataFrame(lines, columns=[*FIRST, *both_sides(judged), *LAST, WORSE_IN]), remarks


def rows_by_cell(rows: pd.DataFrame) -> dict[Key, Row]:
    """Return the rows by the identity of their cell. If a cell has several rows, the last counts."""
    records = [{str(name): value for name, value in row.items()} for row in rows.to_dict("records")]
    return {
        (canonical_parameters(row["parameters"]), *(repr(float(row[name])) for name in COUNTS)): row for row in records
    }


def canonical_parameters(parameters: str) -> str:
    """Return parameters as JSON with sorted names, and today's defaults where a parameter is missing."""
    return json.dumps(completed(json.loads(parameters)), sort_keys=True)


def flat_parameters(row: Row) -> dict[str, Any]:
    """Return a row's plugins, parameters and counts by name: ``{"scene": "pushing", "pushing.hold": 1, "seed": 0.0}``."""
    flat: dict[str, Any] = {}
    for axis, part in completed(json.loads(row["parameters"])).items():
        if isinstance(part, Mapping):
            flat |= {axis: part["name"]} if "name" in part else {}
            flat |= {f"{part.get('name', axis)}.{name}": value for name, value in part.items() if name != "name"}
    return flat | {name: float(row[name]) for name in COUNTS}


def _succeeded(rows: Mapping[Key, Row]) -> dict[Hashable, Row]:
    return {key: row for key, row in rows.items() if row["status"] == "ok"}


def _line(old: Row | None, new: Row | None, judged: Sequence[Column], changes: Sequence[Change]) -> dict[str, Any]:
    """Return the line of one cell, with the values of both sides and the worst of its changes as the outcome."""
    row = new or old or {}
    line = {name: row.get(name) for name in (*IDENTITY, "parameters")}
    for when, side in (("before", old), ("after", new)):
        line |= {
            f"{c.name}_{when}": side.get(c.name) if side else math.nan if c.kind == "number" else "" for c in judged
        }
        line[f"status_{when}"] = side["status"] if side else ""
    outcomes = {change.outcome for change in changes}
    return line | {
        "outcome": next((outcome for outcome in OUTCOMES if outcome in outcomes), "same"),
        "change": "; ".join(change.text for change in changes),
        WORSE_IN: [change.subject for change in changes if change.outcome == "worse"],
    }
