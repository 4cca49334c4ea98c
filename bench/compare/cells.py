"""Compares two results cell by cell: pairs the rows of the same cell and judges each pair."""

from __future__ import annotations

import json
import math
from collections.abc import Hashable, Mapping, Sequence
from itertools import islice
from typing import Any

import pandas as pd

from bench.compare import timings
from bench.compare.judging import Change, Row, has_same_estimates, judge
from bench.experiment.columns import IDENTITY, Column, Columns
from bench.experiment.defaults import completed, missing_parameters

OUTCOMES = ("worse", "better", "changed", "same")
COUNTS = ("samples", "repeats", "seed")
"""Columns that identify a cell, besides the parameters of its plugins."""
FIRST = ("outcome", "change", *IDENTITY, "status_before", "status_after")
"""The first columns of a comparison. The columns of :func:`both_sides` follow, then :data:`LAST`."""
LAST = ("parameters",)
WORSE_IN = "worse_in"
"""Internal column, not written to files: the list of :attr:`Change.subject` of the changes for the worse."""
MAX_CANDIDATES = 50
"""Largest number of unpaired cells that are searched for the one nearest to another unpaired cell."""

Key = tuple[str, ...]


def both_sides(columns: Sequence[Column]) -> list[str]:
    """Return the names of judged columns on both sides: ``bias_before``, ``bias_after``."""
    return [f"{column.name}_{when}" for column in columns for when in ("before", "after")]


def compare_cells(
    before: pd.DataFrame, after: pd.DataFrame, columns: Columns, timed: bool, again: Sequence[pd.DataFrame] = ()
) -> tuple[pd.DataFrame, list[str]]:
    """Return one line per cell of either side, with its identity and outcome, and remarks on times.

    Two rows are of one cell if all their parameters, samples, repeats and seed are equal. A parameter that a stored row
    lacks has its present default. With ``timed``, times are judged too; ``again`` are further runs of before, which show
    the spread between runs.
    """
    old, new = rows_by_cell(before), rows_by_cell(after)
    time_changes: dict[Hashable, list[Change]] = {}
    remarks: list[str] = []
    for column in columns.compared if timed else ():
        if column.comparison and column.comparison.by == "time":
            runs = [_succeeded(rows_by_cell(rows)) for rows in again]
            of_column, time_remarks = timings.judge_times(
                column.name, column.comparison.called, _succeeded(old), _succeeded(new), runs
            )
            remarks += time_remarks
            for key, change in of_column.items():
                time_changes.setdefault(key, []).append(change)
    unpaired = {**_unpaired(old, new, "after"), **_unpaired(new, old, "before")}
    lines = []
    for key in dict.fromkeys([*old, *new]):
        one, two = old.get(key), new.get(key)
        changes = _changes(one, two, columns) if one and two else [_gone_or_new(one, unpaired[key])]
        lines.append(_line(one, two, columns, [*changes, *time_changes.get(key, [])]))
    return pd.DataFrame(lines, columns=[*FIRST, *both_sides(columns.compared), *LAST, WORSE_IN]), remarks


def rows_by_cell(rows: pd.DataFrame) -> dict[Key, Row]:
    """Return the rows by the identity of their cell. If a cell has several rows, the last counts."""
    records = [{str(name): value for name, value in row.items()} for row in rows.to_dict("records")]
    return {
        (canonical_parameters(row["parameters"]), *(repr(float(row[name])) for name in COUNTS)): row for row in records
    }


def canonical_parameters(parameters: str) -> str:
    """Return parameters as JSON with sorted names, and today's defaults where a parameter is missing."""
    return json.dumps(completed(json.loads(parameters)), sort_keys=True)


def assumed_defaults(rows: pd.DataFrame) -> dict[str, Any]:
    """Return the parameters missing from some row, with the defaults assumed for them: ``{"pushing.hold": 1}``."""
    by_names = {}
    for text in rows["parameters"].unique():
        given = json.loads(text)
        parts = {axis: part for axis, part in given.items() if isinstance(part, Mapping)}
        by_names[tuple((axis, part.get("name"), frozenset(part)) for axis, part in parts.items())] = given
    return {name: value for given in by_names.values() for name, value in missing_parameters(given).items()}


def flat_parameters(row: Row) -> dict[str, Any]:
    """Return a row's plugins, parameters and counts by name: ``{"scene": "pushing", "pushing.hold": 1, "seed": 0.0}``."""
    flat: dict[str, Any] = {}
    for axis, part in completed(json.loads(row["parameters"])).items():
        if isinstance(part, Mapping):
            flat |= {axis: part["name"]} if "name" in part else {}
            flat |= {f"{part.get('name', axis)}.{name}": value for name, value in part.items() if name != "name"}
    return flat | {name: float(row[name]) for name in COUNTS}


def differing_parameters(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the names of the parameters that differ between ``rows``, each of :func:`flat_parameters`."""
    names = dict.fromkeys(name for row in rows for name in row)
    return [name for name in names if any(row.get(name) != rows[0].get(name) for row in rows)]


def _succeeded(rows: Mapping[Key, Row]) -> dict[Hashable, Row]:
    return {key: row for key, row in rows.items() if row["status"] == "ok"}


def _unpaired(rows: Mapping[Key, Row], others: Mapping[Key, Row], side: str) -> dict[Key, str]:
    """Return the cells of ``rows`` that ``others`` lack, each with a phrase: the differences of the nearest cell.

    The nearest unpaired cell of ``others``, the side called ``side``, has the same plugins and differs in the fewest
    parameters. The phrase is empty without such a cell.
    """
    candidates: dict[Hashable, list[dict[str, Any]]] = {}
    for key, row in others.items():
        if key not in rows:
            candidates.setdefault(_plugins(row), []).append(flat_parameters(row))
    result = {}
    for key, row in rows.items():
        if key in others:
            continue
        own = flat_parameters(row)
        differences = [
            (differing_parameters([own, other]), other)
            for other in islice(candidates.get(_plugins(row), []), MAX_CANDIDATES)
        ]
        names, nearest = min(differences, key=lambda pair: len(pair[0]), default=([], {}))
        parts = [f"{name}={nearest.get(name)} instead of {own.get(name)}" for name in names]
        result[key] = f"; the nearest cell {side} has {', '.join(parts)}" if parts else ""
    return result


def _plugins(row: Row) -> Hashable:
    """Return the plugins of a row by axis. Unpaired cells are only compared with cells of the same plugins."""
    given = json.loads(row["parameters"])
    return tuple(
        sorted((axis, part["name"]) for axis, part in given.items() if isinstance(part, Mapping) and "name" in part)
    )


def _line(old: Row | None, new: Row | None, columns: Columns, changes: Sequence[Change]) -> dict[str, Any]:
    """Return the line of one cell, with the values of both sides and the worst of its changes as the outcome."""
    row = new or old or {}
    line = {name: row.get(name) for name in (*IDENTITY, "parameters")}
    for when, side in (("before", old), ("after", new)):
        line |= {
            f"{c.name}_{when}": side.get(c.name) if side else math.nan if c.kind == "number" else ""
            for c in columns.compared
        }
        line[f"status_{when}"] = side["status"] if side else ""
    outcomes = {change.outcome for change in changes}
    return line | {
        "outcome": next((outcome for outcome in OUTCOMES if outcome in outcomes), "same"),
        "change": "; ".join(change.text for change in changes),
        WORSE_IN: [change.subject for change in changes if change.outcome == "worse"],
    }


def _changes(old: Row, new: Row, columns: Columns) -> list[Change]:
    """Return the changes of status and of all compared columns except times."""
    if old["status"] != new["status"]:
        return [_status_change(old, new)]
    if old["status"] != "ok":
        return []
    judged = [column for column in columns.compared if column.comparison and column.comparison.by != "time"]
    if any(has_same_estimates(column, old, new) for column in judged):
        # only the reference can differ then, which makes the estimates neither better nor worse
        judged = [c for c in judged if c.comparison and c.comparison.by not in ("interval", "spread")]
    changes = [judge(column, columns, old, new) for column in judged]
    return [change for change in changes if change is not None]


def _gone_or_new(old: Row | None, nearest: str) -> Change:
    if old is None:
        return Change("changed", f"new{nearest}", "new")
    return Change("worse" if old["status"] == "ok" else "changed", f"gone, it was {old['status']}{nearest}", "gone")


def _status_change(old: Row, new: Row) -> Change:
    outcome = "worse" if old["status"] == "ok" else "better" if new["status"] == "ok" else "changed"
    reason = f" ({new['reason']})" if isinstance(new.get("reason"), str) and new["reason"] else ""
    return Change(outcome, f"status {old['status']} to {new['status']}{reason}", "status")
