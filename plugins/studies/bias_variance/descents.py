"""What a study shows where gradients were taken along descents: the descents, and errors relative to their start."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
import pandas as pd

from bench.experiment.columns import Column, setting, text
from bench.experiment.parameters import DESCENT, number_problems
from bench.experiment.views import Table
from bench.report.problems import label_columns, titled
from bench.report.views import Arranged, attempted, estimator_labels, merge_seeds

from .columns import COLUMNS

SHOWN = ("rmse_rel", "rmse_start", "cosine", "grad_norm", "reference_norm", "start_norm")
PATH = (
    setting("share", label="descent"),
    Column("theta", label="|theta|", digits=3),
    Column("cost", label="J", digits=6),
    Column("gradient", label="|grad J|", digits=3),
    Column("speed", label="largest speed", digits=3),
    Column("move", label="largest move", digits=3),
)


def with_start_norm(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows in which those at theta0 also have the norm of the gradient at the start, where a descent begins there."""
    if "start_norm" not in rows or rows["start_norm"].isna().all():
        return rows
    starts = rows["start_norm"].groupby(number_problems(rows, ("scene",), (DESCENT,))).transform("max")
    norm = rows["start_norm"].fillna(starts)
    return rows.assign(start_norm=norm, rmse_start=rows["rmse"] / norm.where(norm > 0))


def tables(shown: Arranged) -> list[Table]:
    """Return a table of each descent and one of errors along it; none without descents."""
    rows = shown.rows[shown.rows.reindex(columns=["descent_path"])["descent_path"].fillna("") != ""]
    if rows.empty:
        return []
    paths = _named(shown, ("scene",), rows)
    lines = [
        pd.DataFrame(json.loads(path)).assign(problem=name)
        for name, path in sorted(set(zip(paths, rows["descent_path"], strict=True)))
    ]
    found = pd.concat(lines, ignore_index=True)[["problem", *(column.name for column in PATH)]]
    found = found.drop_duplicates(["problem", "share"]).sort_values(["problem", "share"], ignore_index=True)
    notes = [
        "Cost J_sigma and its gradient are of the program that is descended, speed and move of a coordinate along its rollout without noise."
    ]
    errors = attempted(merge_seeds(shown.rows))
    errors = errors[np.isfinite(errors["start_norm"])]
    numbers = ["samples"] * (errors["samples"].nunique() > 1) + [DESCENT]
    order = ["problem", "method", "backend", *numbers]
    errors = errors.assign(
        problem=_named(shown, ("scene", "contact", "integrator"), errors), method=estimator_labels(errors)
    )[[*order, *SHOWN]].sort_values(order, ignore_index=True)
    columns = [COLUMNS.by_name[name] for name in (*numbers, *SHOWN[:3], "reference_norm")]
    return [
        Table("descent", found, [text("problem"), *PATH], "the descents along which gradients are taken", notes),
        Table(
            "along_descent",
            errors,
            [text("problem"), text("method", label="estimator"), text("backend"), *columns],
            "errors along descents, in units of the gradient there and of that at the start",
        ),
    ]


def _named(shown: Arranged, parts: Sequence[str], rows: pd.DataFrame) -> pd.Series:
    """Return the name of each row's problem, without the share of its descent."""
    axes = [axis for axis in shown.axes if axis.column == DESCENT]
    names = [name for name in label_columns(shown, parts, axes, rows=rows) if name != DESCENT]
    return titled(rows, names)
