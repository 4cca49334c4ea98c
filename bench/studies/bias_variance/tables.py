"""Writes the main table: CSV with every digit, Markdown and LaTeX to read."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.measure.statistics import UNEXPLAINED, unexplained
from bench.report.tables import csv, escape_latex, escape_markdown, latex_number, number_format
from bench.report.text import axis_value, number
from bench.report.views import NUMBERS, UNSTEADY, VIEWS_OF_LAWS, bias_text, pareto, unsteady
from bench.sweep import axes
from bench.sweep.columns import IDENTITY
from bench.sweep.experiment import Experiment
from bench.sweep.files import write_all

PAGE_ROWS = 40
"""Most rows of a LaTeX table that fit a page."""
DOUBTED = " ?"
FOOTNOTES = [
    "0 (< u): the bias is not distinguishable from 0, its 95% interval reaches up to u. "
    f"{DOUBTED.strip()}: the estimator declares to be unbiased and the interval excludes 0, so {UNEXPLAINED}.",
    "relative bias and rel. RMSE: divided by the norm of the reference gradient. A relative RMSE above 1 is worse "
    "than answering zero.",
    "variance: trace of the covariance of one estimate. time: one estimate, steady state, without compilation. "
    f"{UNSTEADY}: the interquartile range of its calls is over 20% of it; something else ran beside them.",
]


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``bias_variance`` (.csv, .md, .tex) and ``speed_accuracy.csv``; returns their paths."""
    table = readable(experiment, rows)
    return write_all(
        experiment.directory,
        {
            "bias_variance.csv": csv(axes.table(experiment, rows)),
            "bias_variance.md": markdown(table),
            "bias_variance.tex": latex(table),
            "speed_accuracy.csv": csv(speed_accuracy(rows)),
        },
    )


def problem(rows: pd.DataFrame) -> pd.Series:
    """Number the problem of each row: scene, contact law and integrator with all their parameters, and theta."""
    numbers: dict[str, int] = {}
    texts = [
        json.dumps([given.get(a) for a in ("scene", "contact", "integrator", "theta")]) for given in axes.parsed(rows)
    ]
    return pd.Series([numbers.setdefault(text, len(numbers)) for text in texts], index=rows.index, dtype=int)


def speed_accuracy(rows: pd.DataFrame) -> pd.DataFrame:
    """Return error against time, with ``pareto`` where no other good row of the problem is faster and more accurate."""
    results = ["rmse_rel", "bias_rel", "time_s", "time_iqr_s", "compile_s", "rollouts", "gradients"]
    table = rows[["experiment", *IDENTITY, "status", *results]].assign(pareto=False)
    good = table[(table["status"] == "ok") & np.isfinite(table["rmse_rel"]) & np.isfinite(table["time_s"])]
    for _, part in good.groupby(problem(good.assign(parameters=rows["parameters"]))):
        table.loc[part.index[pareto(part["time_s"], part["rmse_rel"])], "pareto"] = True
    return table


@dataclass(frozen=True)
class Readable:
    """The main table as text, not yet escaped for any format."""

    title: str
    shared: list[str]
    headers: list[str]
    numeric: list[bool]
    """Per column, whether it holds numbers."""
    body: list[list[str]]
    reasons: list[str]
    best: list[bool]
    """Per row, whether its error is the lowest of its problem, beyond the intervals."""


def readable(experiment: Experiment, rows: pd.DataFrame) -> Readable:
    """Return the main table: identity and swept columns that vary, the results, status and reason of failures."""
    swept_axes = axes.axes(experiment.sweep, rows)
    swept = [axis.column for axis in swept_axes if axis.column not in rows and not _is_shown(rows, axis)]
    rows = axes.relabelled(axes.with_axes(experiment, rows), swept_axes)
    varying, shared = _varying(rows, swept)
    reasons = {text: i + 1 for i, text in enumerate(dict.fromkeys(r for r in rows["reason"] if r))}
    status = ["status"] if reasons or (rows["status"] != "ok").any() else []
    results = ["bias [95% interval]", "relative bias", "variance", "rel. RMSE", "cosine", "time [ms]"]
    body = []
    for row in rows.to_dict("records"):
        cells = [_text(row[c]) for c in varying] + _results(row)
        note = f" ({reasons[row['reason']]})" if row["reason"] else ""
        body.append(cells + [row["status"] + note for _ in status])
    return Readable(
        title=f"{rows['experiment'].iloc[0]}: bias and variance",
        shared=shared,
        headers=[*varying, *results, *status],
        numeric=[
            *(c in (*NUMBERS, *swept, "seed") for c in varying),
            *(True for _ in results),
            *(False for _ in status),
        ],
        body=body,
        reasons=[f"({i}) {text}" for text, i in reasons.items()],
        best=best(rows).tolist(),
    )


def best(rows: pd.DataFrame) -> pd.Series:
    """Return, per row, whether its RMSE is its problem's lowest, with an interval apart from every other estimator's.

    The interval of an RMSE goes from the lower to the upper ends of bias and variance, RMSE^2 = bias^2 + variance.
    """
    low, high = (np.sqrt(rows[f"bias_{end}"] ** 2 + rows.get(f"variance_{end}", math.nan)) for end in ("low", "high"))
    estimator = rows["estimator"] + "[" + rows["estimator_params"] + "]"
    ends = pd.DataFrame({"low": low, "high": high, "estimator": estimator, "rmse": rows["rmse"]})
    result = pd.Series(False, index=rows.index)
    for _, part in ends[rows["status"] == "ok"].groupby([problem(rows), rows["samples"]]):
        first = part.loc[part["rmse"].idxmin()] if part["rmse"].notna().any() else None
        if first is not None:
            others = part[part["estimator"] != first["estimator"]]
            mine = part[part["estimator"] == first["estimator"]]
            if len(others) and mine["high"].max() < others["low"].min() and others["low"].notna().all():
                result[mine.index] = True
    return result


def _varying(rows: pd.DataFrame, swept: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the identity columns to show, and sentences with the values of the others."""
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
    """Return whether a swept axis is already in the table, as the view of a contact law's parameter."""
    own = np.isfinite(axes.values_of(axis, rows))
    return any(axes.shown_by(view, axis, rows)[own].all() for view in VIEWS_OF_LAWS)


def _named(row: Any, columns: Sequence[str]) -> str:
    texts = {c: _text(row[c]) for c in columns}
    return ", ".join(f"{c} {text}" for c, text in texts.items() if text not in ("", "none", "-"))


def _text(value: Any) -> str:
    return value if isinstance(value, str) else axis_value(value)


def _results(row: Any) -> list[str]:
    if row["status"] != "ok":
        return ["-"] * 6
    return [
        bias_text(row) + DOUBTED * unexplained(row["reason"]),
        bias_text(row, row["reference_norm"], interval=False),
        number(row["variance"], 3), number(row["rmse_rel"], 3), number(row["cosine"], 3),
        number(row["time_s"] * 1e3, 3) + UNSTEADY * bool(unsteady(row)),
    ]  # fmt: skip


def markdown(table: Readable) -> str:
    """Write the main table in Markdown."""
    e = escape_markdown
    out = [f"# {e(table.title)}", ""]
    for text in table.shared:
        out += [e(text), ""]
    out.append("| " + " | ".join(map(e, table.headers)) + " |")
    out.append("|" + "|".join("--:" if right else "---" for right in table.numeric) + "|")
    out += ["| " + " | ".join(map(e, cells)) + " |" for cells in table.body]
    out += ["", *(f"- {e(note)}" for note in FOOTNOTES)]
    if table.reasons:
        out += ["", "Notes on the status:", "", *(f"- {e(reason)}" for reason in table.reasons)]
    return "\n".join(out) + "\n"


def latex(table: Readable) -> str:
    """Write the main table in LaTeX: booktabs, numbers aligned by siunitx; a ``longtable`` if it does not fit a page.

    The RMSE of a row that is best of its problem beyond the intervals is bold.
    """
    e = escape_latex
    texts = [[row[i] for row in table.body] for i in range(len(table.headers))]
    formats = [number_format(column) if right else "" for column, right in zip(texts, table.numeric, strict=True)]
    spec = "".join(f"S[table-format={form}]" if form else "l" for form in formats)
    heads = [f"{{{e(text)}}}" if form else e(text) for text, form in zip(table.headers, formats, strict=True)]
    error = table.headers.index("rel. RMSE")
    body = []
    for row, first in zip(table.body, table.best, strict=True):
        cells = [latex_number(text) if form else e(text) for text, form in zip(row, formats, strict=True)]
        if first:
            cells[error] = rf"\bfseries {cells[error]}"
        body.append(" & ".join(cells) + r" \\")
    head = [r"\toprule", " & ".join(heads) + r" \\", r"\midrule"]
    if len(table.body) > PAGE_ROWS:
        kind, packages = "longtable", "booktabs,longtable,siunitx"
        body = [*head, r"\endhead", r"\bottomrule", r"\endfoot", *body, r"\end{longtable}"]
    else:
        kind, packages = "tabular", "booktabs,siunitx"
        body = [*head, *body, r"\bottomrule", r"\end{tabular}", ""]
    setup = [r"\begingroup\footnotesize\setlength{\tabcolsep}{3pt}", r"\sisetup{detect-weight=true,mode=text}"]
    out = [rf"% needs \usepackage{{{packages}}}", *setup, rf"\begin{{{kind}}}{{{spec}}}", *body]
    bold = ["Bold: lowest error of its problem, its interval apart from that of every other estimator."] * any(
        table.best
    )
    notes = (table.title + ".", *table.shared, *FOOTNOTES, *bold, *table.reasons)
    return "\n".join([*out, *(rf"\noindent {e(note)}\par" for note in notes), r"\endgroup"]) + "\n"
