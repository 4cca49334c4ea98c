"""Compares two results cell by cell: which cells are the same, and what became of each."""

from __future__ import annotations

import json
import math
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import pandas as pd

from bench.compare import timings
from bench.compare.judging import Change, Row, judge, same_estimates
from bench.experiment.columns import IDENTITY, Column, Columns

OUTCOMES = ("worse", "better", "changed", "same")
COUNTS = ("samples", "repeats", "seed")
"""What identifies a cell besides the parameters of its plugins."""
FIRST = ("outcome", "change", *IDENTITY, "status_before", "status_after")
"""The first columns of a comparison, then its last; those of :func:`both_sides` stand between."""
LAST = ("parameters",)


def both_sides(columns: Sequence[Column]) -> list[str]:
    """Return the columns that show judged columns of both sides: ``bias_before``, ``bias_after``."""
    return [f"{column.name}_{when}" for column in columns for when in ("before", "after")]


def compared(
    before: pd.DataFrame, after: pd.DataFrame, columns: Columns, timed: bool, again: Sequence[pd.DataFrame] = ()
) -> tuple[pd.DataFrame, list[str]]:
    """Return a line per cell of either side, with its identity and what became of it, and remarks on times.

    Cells are the same where all their parameters, samples, repeats and seed are. Times are judged with ``timed``, and
    ``again`` are further runs of before that show the spread between runs.
    """
    old, new = rows_by_cell(before), rows_by_cell(after)
    times: dict[Hashable, list[Change]] = {}
    remarks: list[str] = []
    for column in columns.compared if timed else ():
        if column.comparison and column.comparison.by == "time":
            runs = [_good(rows_by_cell(rows)) for rows in again]
            changes, said = timings.judged(column.name, column.comparison.called, _good(old), _good(new), runs)
            remarks += said
            for key, change in changes.items():
                times.setdefault(key, []).append(change)
    lines = [_line(old.get(key), new.get(key), columns, times.get(key, [])) for key in dict.fromkeys([*old, *new])]
    return pd.DataFrame(lines, columns=[*FIRST, *both_sides(columns.compared), *LAST]), remarks


def _good(rows: Mapping[tuple[str, ...], Row]) -> dict[Hashable, Row]:
    return {key: row for key, row in rows.items() if row["status"] == "ok"}


def rows_by_cell(rows: pd.DataFrame) -> dict[tuple[str, ...], Row]:
    """Return the rows by their identity; of several rows of one cell, the last."""
    records = [{str(name): value for name, value in row.items()} for row in rows.to_dict("records")]
    return {(same(row["parameters"]), *(repr(float(row[name])) for name in COUNTS)): row for row in records}


def same(parameters: str) -> str:
    """Return parameters as JSON, in an order that does not depend on how they were written."""
    return json.dumps(json.loads(parameters), sort_keys=True)


def _line(old: Row | None, new: Row | None, columns: Columns, times: Sequence[Change]) -> dict[str, Any]:
    """Return the line of one cell."""
    there = new if new is not None else old
    assert there is not None
    line = {name: there.get(name) for name in (*IDENTITY, "parameters")}
    for when, row in (("before", old), ("after", new)):
        line |= {f"{c.name}_{when}": _missing(c) if row is None else row.get(c.name) for c in columns.compared}
        line[f"status_{when}"] = "" if row is None else row["status"]
    changes = [*_changes(old, new, columns), *times]
    outcomes = {change.outcome for change in changes}
    outcome = next((o for o in OUTCOMES if o in outcomes), "same")
    return line | {"outcome": outcome, "change": "; ".join(change.text for change in changes)}


def _missing(column: Column) -> Any:
    return math.nan if column.kind == "number" else ""


def _changes(old: Row | None, new: Row | None, columns: Columns) -> list[Change]:
    """Return the changes of everything except times."""
    if old is None or new is None:
        return [_gone(old)]
    if old["status"] != new["status"]:
        return [_status(old, new)]
    if old["status"] != "ok":
        return []
    judged = [column for column in columns.compared if column.comparison and column.comparison.by != "time"]
    if any(same_estimates(column, old, new) for column in judged):
        # what is left to differ is the reference, and that is no merit or fault of the estimates
        judged = [
            column for column in judged if column.comparison and column.comparison.by not in ("interval", "spread")
        ]
    changes = [judge(column, columns, old, new) for column in judged]
    return [change for change in changes if change is not None]


def _gone(old: Row | None) -> Change:
    if old is None:
        return Change("changed", "new")
    return Change("worse" if old["status"] == "ok" else "changed", f"gone, it was {old['status']}")


def _status(old: Row, new: Row) -> Change:
    kind = "worse" if old["status"] == "ok" else "better" if new["status"] == "ok" else "changed"
    reason = f" ({new['reason']})" if isinstance(new.get("reason"), str) and new["reason"] else ""
    return Change(kind, f"status {old['status']} to {new['status']}{reason}")
