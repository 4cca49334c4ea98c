"""Compares two results cell by cell: pairs the rows of the same cell and judges each pair."""

from __future__ import annotations

import json
from collections.abc import Sequence

import pandas as pd

from bench.compare import timings
from bench.compare.judging import judge_cell, rule_of
from bench.experiment.columns import IDENTITY, Column, Columns
from bench.experiment.grid import COUNTS
from bench.experiment.parameters import parsed

OUTCOMES = ("worse", "better", "changed", "same")
FIRST = ("outcome", "change", *IDENTITY, "status_before", "status_after")
"""The first columns of a comparison. The columns of :func:`both_sides` follow, then :data:`LAST`."""
LAST = ("parameters",)
WORSE_IN = "worse_in"
"""Internal column, not written to files: the list of :attr:`Change.subject` of the changes for the worse."""


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
    every = [*dict.fromkeys([*old.index, *new.index])]
    sides = {"before": old.reindex(every), "after": new.reindex(every)}
    pairs = zip(every, *(side.to_dict("records") for side in sides.values()), strict=True)
    changes = {
        key: judge_cell(columns, was if key in old.index else None, now if key in new.index else None)
        for key, was, now in pairs
    }
    remarks: list[str] = []
    for column in judged if again else ():
        if rule_of(column).by == "time":
            times = [rows.loc[rows["status"] == "ok", column.name] for rows in (old, new, *more)]
            of_column, of_times = timings.judge_times(rule_of(column).called, *times)
            remarks += of_times
            for key, change in of_column.items():
                changes[key].append(change)
    known = sides["after"].where(sides["after"]["status"].notna(), sides["before"])
    table = known[[*IDENTITY, *LAST]].assign(
        **{
            f"{c.name}_{when}": side[c.name] if c.kind == "number" else side[c.name].astype(object).fillna("")
            for c in judged
            for when, side in sides.items()
        },
        **{f"status_{when}": side["status"].fillna("") for when, side in sides.items()},
        outcome=[
            min((change.outcome for change in own), key=OUTCOMES.index, default="same") for own in changes.values()
        ],
        change=["; ".join(change.text for change in own) for own in changes.values()],
        **{WORSE_IN: [[change.subject for change in own if change.outcome == "worse"] for own in changes.values()]},
    )
    return table[[*FIRST, *both_sides(judged), *LAST, WORSE_IN]].reset_index(drop=True), remarks


def rows_by_cell(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows by the identity of their cell. If a cell has several rows, the last counts."""
    parts = [rows["parameters"].map(canonical_parameters), *(rows[name].astype(float).map(repr) for name in COUNTS)]
    frame = rows.set_axis(pd.Index([" ".join(part) for part in zip(*parts, strict=True)], dtype=object))
    return frame[~frame.index.duplicated(keep="last")]


def canonical_parameters(parameters: str) -> str:
    """Return parameters as JSON with sorted names, and today's defaults where a parameter is missing."""
    return json.dumps(parsed(parameters), sort_keys=True)
