"""Writes the main table: all digits as CSV, rounded as Markdown, and a pivot table for papers in Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.experiment import axes
from bench.experiment.columns import IDENTITY
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import number_problems
from bench.measure.statistics import UNEXPLAINED, is_unexplained
from bench.report.problems import value_text
from bench.report.tables import csv, escape_markdown
from bench.report.text import number
from bench.report.views import NUMBERS, UNSTEADY, VIEWS_OF_LAWS, arrange, bias_text, pareto, unsteady
from bench.run.files import write_all
from bench.studies.bias_variance import pivot

DOUBTED = " ?"
FOOTNOTES = [
    "0 (< u): the bias is not distinguishable from 0, its 95% interval reaches up to u. "
    f"{DOUBTED.strip()}: the estimator declares to be unbiased and the interval excludes 0, so {UNEXPLAINED}.",
    "relative bias and rel. RMSE: divided by the norm of the reference gradient. A relative RMSE above 1 is worse "
    "than the zero estimate.",
    "variance: trace of the covariance of one estimate. time: one estimate, steady state, without compilation. "
    f"{UNSTEADY}: the interquartile range of its calls is over 20% of it; something else ran beside them.",
]


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``bias_variance`` (.csv, .md, .tex) and ``speed_accuracy.csv``; return the files' paths."""
    paper = pivot.pivot(experiment, arrange(experiment, rows))
    return write_all(
        experiment.directory,
        {
            "bias_variance.csv": csv(axes.table(experiment, rows)),
            "bias_variance.md": f"{pivot.markdown(paper)}\n{markdown(readable(experiment, rows))}",
            "bias_variance.tex": pivot.latex(paper),
            "speed_accuracy.csv": csv(speed_accuracy(rows)),
        },
    )


def speed_accuracy(rows: pd.DataFrame) -> pd.DataFrame:
    """Return errors and costs; ``pareto`` is True where no other ok row of the problem is both faster and more accurate."""
    results = ["rmse_rel", "bias_rel", "time_s", "time_iqr_s", "compile_s", "rollouts", "gradients"]
    table = rows[["experiment", *IDENTITY, "status", *results]].assign(pareto=False)
    good = table[(table["status"] == "ok") & np.isfinite(table["rmse_rel"]) & np.isfinite(table["time_s"])]
    for _, part in good.groupby(number_problems(rows).loc[good.index]):
        table.loc[part.index[pareto(part["time_s"], part["rmse_rel"])], "pareto"] = True
    return table


@dataclass(frozen=True)
class Readable:
    """The main table as strings, not yet escaped for any format."""

    title: str
    shared: list[str]
    headers: list[str]
    numeric: list[bool]
    """Whether each column is numeric."""
    body: list[list[str]]
    reasons: list[str]


def readable(experiment: Experiment, rows: pd.DataFrame) -> Readable:
    """Return the main table as strings: identity and swept columns that vary, results, status, and numbered reasons."""
    swept_axes = axes.axes(experiment.sweep, rows)
    swept = [axis.column for axis in swept_axes if axis.column not in rows and not _is_shown(rows, axis)]
    rows = axes.relabel(axes.with_axes(experiment, rows), swept_axes)
    varying, shared = _varying(rows, swept)
    reasons = {text: i + 1 for i, text in enumerate(dict.fromkeys(r for r in rows["reason"] if r))}
    status = ["status"] if reasons or (rows["status"] != "ok").any() else []
    results = ["bias [95% interval]", "relative bias", "variance", "rel. RMSE", "cosine", "time [ms]"]
    body = []
    for row in rows.to_dict("records"):
        cells = [value_text(row[c]) for c in varying] + _results(row)
        note = f" ({reasons[row['reason']]})" if row["reason"] else ""
        body.append(cells + [row["status"] + note for _ in status])
    return Readable(
        title="Every cell",
        shared=shared,
        headers=[*varying, *results, *status],
        numeric=[
            *(c in (*NUMBERS, *swept, "seed") for c in varying),
            *(True for _ in results),
            *(False for _ in status),
        ],
        body=body,
        reasons=[f"({i}) {text}" for text, i in reasons.items()],
    )


def _varying(rows: pd.DataFrame, swept: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the identity and swept columns to show, and sentences with the values of the other columns."""
    names = (*IDENTITY, *swept)
    varying = [c for c in names if rows[c].nunique(dropna=False) > 1]
    problems = rows.groupby(["scene", "contact"], sort=False)
    main = ("scene", "contact", "backend", "estimator", "estimator_params")
    implied = [c for c in varying if c not in main and (problems[c].nunique(dropna=False) == 1).all()]
    shared = [f"The same in every row: {_named(rows.iloc[0], [c for c in names if c not in varying])}."]
    for (scene, contact), part in problems:
        if named := _named(part.iloc[0], implied):
            problem = f"{scene}, {contact}" if contact != "none" else str(scene)
            shared.append(f"In every row of {problem}: {named}.")
    return [c for c in varying if c not in implied], shared


def _is_shown(rows: pd.DataFrame, axis: axes.Axis) -> bool:
    """Return whether the column ``stiffness`` or ``smoothing`` already shows a swept axis."""
    own = np.isfinite(axes.values_of(axis, rows))
    return any(axes.shown_by(view, axis, rows)[own].all() for view in VIEWS_OF_LAWS)


def _named(row: Any, columns: Sequence[str]) -> str:
    texts = {c: value_text(row[c]) for c in columns}
    return ", ".join(f"{c} {text}" for c, text in texts.items() if text not in ("", "none", "-"))


def _results(row: Any) -> list[str]:
    if row["status"] != "ok":
        return ["-"] * 6
    return [
        bias_text(row) + DOUBTED * is_unexplained(row["reason"]),
        bias_text(row, row["reference_norm"], interval=False),
        number(row["variance"], 3), number(row["rmse_rel"], 3), number(row["cosine"], 3),
        number(row["time_s"] * 1e3, 3) + UNSTEADY * bool(unsteady(row)),
    ]  # fmt: skip


def markdown(table: Readable) -> str:
    """Return the main table in Markdown, with footnotes and the numbered reasons."""
    e = escape_markdown
    out = [f"## {e(table.title)}", ""]
    for text in table.shared:
        out += [e(text), ""]
    out.append("| " + " | ".join(map(e, table.headers)) + " |")
    out.append("|" + "|".join("--:" if right else "---" for right in table.numeric) + "|")
    out += ["| " + " | ".join(map(e, cells)) + " |" for cells in table.body]
    out += ["", *(f"- {e(note)}" for note in FOOTNOTES)]
    if table.reasons:
        out += ["", "Notes on the status:", "", *(f"- {e(reason)}" for reason in table.reasons)]
    return "\n".join(out) + "\n"
