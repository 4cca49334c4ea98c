"""Tables of gradient checks for programs: a line per check and step, per component of theta, and per point."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment.columns import IDENTITY
from bench.measure.gradcheck import VERDICTS
from bench.report.problems import problem_numbers
from bench.report.text import counted, listed
from bench.studies.gradient_check.columns import COLUMNS
from bench.studies.gradient_check.points import is_trusted

PER_CHECK = ["point", "sample", "direction", "derivative_program"]
PER_STEP = ["derivative_differences", "relative_error", "mode_minus", "mode_plus"]
PER_COMPONENT = (
    "component", "component_program", "component_difference", "component_uncertainty", "component_step",
    "component_ratio", "component_left", "component_right", "component_verdict",
)  # fmt: skip
PROBLEM = ("scene", "contact", "integrator")
"""Parts of the grid that identify a problem."""


def checks(rows: pd.DataFrame) -> Iterator[tuple[dict[str, Any], int, str]]:
    """Yield each check of each row: the row, the number of the check within it, and the verdict."""
    for row in rows.to_dict("records"):
        for i, verdict in enumerate(row["check_verdict"]):
            yield {str(name): value for name, value in row.items()}, i, verdict


def long_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell, check and eps, and one line per cell that could not be checked.

    Columns that are not the study's own, such as swept parameters, are last. The column ``parameters`` is omitted,
    since it would be repeated on every line: ``rows.parquet`` has it under the same ``key``.
    """
    whole = ["experiment", *IDENTITY, "dim", "status", "reason"]
    added = [name for name in rows if name not in COLUMNS.by_name]
    last = list(dict.fromkeys(["key", *map(str, added), *(name for name in ("study",) if name in rows)]))
    lines = []
    for row, i, verdict in checks(rows):
        check = {name: row[name] for name in whole} | {name: row[name][i] for name in PER_CHECK}
        end = {"verdict": verdict} | {name: row[name] for name in last}
        count = len(row["eps"])
        for k in range(count):
            values = {name: row[name][i * count + k] for name in PER_STEP}
            lines.append(check | {"eps": row["eps"][k]} | values | end)
    unchecked = rows[[len(verdicts) == 0 for verdicts in rows["check_verdict"]]]
    lines += unchecked[[*whole, "verdict", *last]].to_dict("records")
    table = pd.DataFrame(lines, columns=[*whole, *PER_CHECK, "eps", *PER_STEP, "verdict", *last])
    counts = ["horizon", "samples", "repeats", "dim", "seed", "sample", "direction"]
    return table.astype(dict.fromkeys(counts, "Int64"))


def component_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell and component of theta, with the columns :data:`PER_COMPONENT`."""
    names = ["experiment", *IDENTITY, "dim"]
    lines = [
        {name: row[name] for name in names} | dict(zip(PER_COMPONENT, values, strict=True)) | {"key": row["key"]}
        for row in rows.to_dict("records")
        for values in zip(*(row[name] for name in PER_COMPONENT), strict=True)
    ]
    return pd.DataFrame(lines, columns=[*names, *PER_COMPONENT, "key"])


def by_point(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell and point: its worst verdict, and the largest error among its checks, with the eps.

    The error of a check is the smallest over all eps. ``row`` is the position of the cell in ``rows``, whose other columns
    follow. ``problem`` is a number, the same for cells with equal parameters of scene, contact law and integrator.
    """
    cells = rows.reset_index(drop=True).assign(problem=problem_numbers(rows, PROBLEM).to_numpy())
    lines = [
        {"row": row["row"], "point": row["point"][i], "verdict": verdict, "rank": VERDICTS.index(verdict),
         "error": row["check_error"][i], "eps": row["check_eps"][i]}
        for row, i, verdict in checks(cells.assign(row=cells.index))
    ]  # fmt: skip
    table = pd.DataFrame(lines, columns=["row", "point", "verdict", "rank", "error", "eps"])
    table = table.sort_values(["rank", "error"], ascending=[True, False], kind="stable")
    table = table.drop_duplicates(["row", "point"]).sort_index()
    return table.join(cells.drop(columns=table.columns, errors="ignore"), on="row")


UNDER_NOISE = "noise"
"""Point of a jump or a missed slope that only noise reaches: the gradient itself can be right."""


def not_right(rows: pd.DataFrame) -> str:
    """Return which checks show a gradient that is wrong or open, by verdict, in words; empty without any.

    What only noise reaches does not count as a fault of the gradient.
    """
    points: dict[str, list[str]] = {}
    cells = set()
    for row, i, verdict in checks(rows):
        point = row["point"][i]
        if not is_trusted(point, verdict) and point != UNDER_NOISE:
            points.setdefault(verdict, []).append(point)
            cells.add(row["key"])
    verdicts = listed(f"{verdict} ({', '.join(dict.fromkeys(at))})" for verdict, at in points.items()) if points else ""
    return f"{verdicts} in {len(cells)} of {counted(len(rows), 'cell')}" if points else ""


def untrusted(summary: pd.DataFrame) -> pd.DataFrame:
    """Return the lines of :func:`by_point` whose gradient cannot be trusted."""
    pairs = zip(summary["point"], summary["verdict"], strict=True)
    return summary[np.array([not is_trusted(point, verdict) for point, verdict in pairs], dtype=bool)]
