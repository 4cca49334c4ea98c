"""Compares two results cell by cell: which cells are the same, and what became of each."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import pandas as pd

from bench.compare.judging import Change, Row, judge, time_basis
from bench.sweep.columns import IDENTITY, Column, Columns

OUTCOMES = ("worse", "better", "changed", "same")
COUNTS = ("samples", "repeats", "seed")
"""What identifies a cell besides the parameters of its plugins."""
FIRST = ("outcome", "change", *IDENTITY, "status_before", "status_after")
"""The first columns of a comparison, then its last; those of :func:`both_sides` stand between."""
LAST = ("time_judged_by", "parameters")


def both_sides(columns: Sequence[Column]) -> list[str]:
    """Return the columns that show judged columns of both sides: ``bias_before``, ``bias_after``."""
    return [f"{column.name}_{when}" for column in columns for when in ("before", "after")]


def compared(before: pd.DataFrame, after: pd.DataFrame, columns: Columns, timings: bool) -> pd.DataFrame:
    """Return a line per cell of either side: its identity, what became of it, and how its time was judged.

    Cells are the same where all their parameters, samples, repeats and seed are.
    """
    old, new = _by_identity(before), _by_identity(after)
    judged = [column for column in columns.judged if timings or _is_no_time(column)]
    lines = [_line(old.get(key), new.get(key), columns, judged) for key in dict.fromkeys([*old, *new])]
    return pd.DataFrame(lines, columns=[*FIRST, *both_sides(columns.judged), *LAST])


def _is_no_time(column: Column) -> bool:
    return column.judged is not None and column.judged.by != "time"


def _by_identity(rows: pd.DataFrame) -> dict[tuple[str, ...], Row]:
    """Return the rows by their identity; of several rows of one cell, the last."""
    records = [{str(name): value for name, value in row.items()} for row in rows.to_dict("records")]
    return {(same(row["parameters"]), *(repr(float(row[name])) for name in COUNTS)): row for row in records}


def same(parameters: str) -> str:
    """Return parameters as JSON, in an order that does not depend on how they were written."""
    return json.dumps(json.loads(parameters), sort_keys=True)


def _line(old: Row | None, new: Row | None, columns: Columns, judged: Sequence[Column]) -> dict[str, Any]:
    """Return the line of one cell."""
    there = new if new is not None else old
    assert there is not None
    line = {name: there.get(name) for name in (*IDENTITY, "parameters")}
    for when, row in (("before", old), ("after", new)):
        line |= {f"{c.name}_{when}": _missing(c) if row is None else row.get(c.name) for c in columns.judged}
        line[f"status_{when}"] = "" if row is None else row["status"]
    changes, judged_by = _changes(old, new, columns, judged)
    outcomes = {change.outcome for change in changes}
    outcome = next((o for o in OUTCOMES if o in outcomes), "same")
    return line | {
        "outcome": outcome,
        "change": "; ".join(change.text for change in changes),
        "time_judged_by": judged_by,
    }


def _missing(column: Column) -> Any:
    return math.nan if column.kind == "number" else ""


def _changes(old: Row | None, new: Row | None, columns: Columns, judged: Sequence[Column]) -> tuple[list[Change], str]:
    if old is None or new is None:
        return [_gone(old)], ""
    if old["status"] != new["status"]:
        return [_status(old, new)], ""
    if old["status"] != "ok":
        return [], ""
    changes = [judge(column, columns, old, new) for column in judged]
    bases = [time_basis(column, old, new) for column in judged if not _is_no_time(column)]
    return [change for change in changes if change is not None], next(filter(None, bases), "")


def _gone(old: Row | None) -> Change:
    if old is None:
        return Change("changed", "new")
    return Change("worse" if old["status"] == "ok" else "changed", f"gone, it was {old['status']}")


def _status(old: Row, new: Row) -> Change:
    kind = "worse" if old["status"] == "ok" else "better" if new["status"] == "ok" else "changed"
    reason = f" ({new['reason']})" if isinstance(new.get("reason"), str) and new["reason"] else ""
    return Change(kind, f"status {old['status']} to {new['status']}{reason}")
