"""Tables of gradient checks for programs: a line per check and step, per component of theta, and per point."""

from __future__ import annotations

import numpy as np
import pandas as pd

from bench.experiment.columns import IDENTITY
from bench.gradient import VERDICTS
from bench.report.problems import problem_numbers
from bench.report.text import counted, listed

from .columns import COLUMNS
from .points import is_trusted

PER_CHECK = ["point", "sample", "direction", "derivative_program"]
PER_STEP = ["derivative_differences", "relative_error", "mode_minus", "mode_plus"]
PER_COMPONENT = (
    "component", "component_program", "component_difference", "component_uncertainty", "component_step",
    "component_ratio", "component_left", "component_right", "component_verdict",
)  # fmt: skip
PROBLEM = ("scene", "contact", "integrator")
"""Parts of the grid that identify a problem."""


def checks(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per check with the columns of its row; ``row`` is the position of the row."""
    split = {
        name: [np.array_split(np.asarray(values, dtype=object), max(len(verdicts), 1))
               for values, verdicts in zip(rows[name], rows["check_verdict"], strict=True)]
        for name in PER_STEP
    }  # fmt: skip
    whole = rows.drop(columns="verdict").rename(
        columns={"check_verdict": "verdict", "check_error": "error", "check_eps": "at_eps"}
    )
    whole = whole.assign(row=range(len(rows)), **split)[rows["check_verdict"].map(len) > 0]
    return whole.explode([*PER_CHECK, "verdict", "error", "at_eps", *PER_STEP], ignore_index=True)


def long_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell, check and eps, and one line per cell that could not be checked.

    Columns that are not the study's own, such as swept parameters, are last. The column ``parameters`` is omitted,
    since it would be repeated on every line: ``rows.parquet`` has it under the same ``key``.
    """
    whole = ["experiment", *IDENTITY, "dim", "status", "reason"]
    added = [str(name) for name in rows if name not in COLUMNS.by_name]
    last = list(dict.fromkeys(["key", *added, *(name for name in ("study",) if name in rows)]))
    names = [*whole, *PER_CHECK, "eps", *PER_STEP, "verdict", *last]
    lines = checks(rows).explode(["eps", *PER_STEP], ignore_index=True)
    unchecked = rows.loc[rows["check_verdict"].map(len) == 0, [*whole, "verdict", *last]]
    table = pd.concat([lines[names].infer_objects(), unchecked], ignore_index=True).reindex(columns=names)
    counts = ["horizon", "samples", "repeats", "dim", "seed", "sample", "direction"]
    return table.astype(dict.fromkeys(counts, float)).astype(dict.fromkeys(counts, "Int64"))


def component_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell and component of theta, with the columns :data:`PER_COMPONENT`."""
    names = ["experiment", *IDENTITY, "dim", *PER_COMPONENT, "key"]
    given = rows.loc[rows["component"].map(len) > 0, names]
    return given.explode([*PER_COMPONENT], ignore_index=True).infer_objects()


def by_point(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per cell and point: its worst verdict, and the largest error among its checks, with the eps.

    The error of a check is the smallest over all eps. ``row`` is the position of the cell in ``rows``, whose other columns
    follow. ``problem`` is a number, the same for cells with equal parameters of scene, contact law and integrator.
    """
    cells = rows.reset_index(drop=True).assign(problem=problem_numbers(rows, PROBLEM).to_numpy())
    table = checks(cells)[["row", "point", "verdict", "error", "at_eps"]].rename(columns={"at_eps": "eps"})
    table = table.astype({"error": float, "eps": float}).assign(rank=table["verdict"].map(VERDICTS.index))
    table = table.sort_values(["rank", "error"], ascending=[True, False], kind="stable")
    table = table.drop_duplicates(["row", "point"]).sort_index()
    return table.join(cells.drop(columns=table.columns, errors="ignore"), on="row")


UNDER_NOISE = "noise"
"""Point of a jump or a missed slope that only noise reaches: the gradient itself can be right."""


def not_right(rows: pd.DataFrame) -> str:
    """Return which checks show a gradient that is wrong or open, by verdict, in words; empty without any.

    What only noise reaches does not count as a fault of the gradient.
    """
    found = untrusted(checks(rows)).query("point != @UNDER_NOISE", local_dict={"UNDER_NOISE": UNDER_NOISE})
    if found.empty:
        return ""
    points = found.groupby("verdict", sort=False)["point"].unique()
    verdicts = listed(f"{verdict} ({', '.join(at)})" for verdict, at in points.items())
    return f"{verdicts} in {found['key'].nunique()} of {counted(len(rows), 'cell')}"


def untrusted(summary: pd.DataFrame) -> pd.DataFrame:
    """Return the lines, of checks or of points, whose gradient cannot be trusted."""
    pairs = zip(summary["point"], summary["verdict"], strict=True)
    return summary[np.array([not is_trusted(point, verdict) for point, verdict in pairs], dtype=bool)]
