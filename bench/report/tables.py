"""Rows as files: CSV with every digit, Markdown and LaTeX to read."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from bench.report.views import NUMBERS, UNSTEADY, axis_value, bias_text, number, pareto, unsteady
from bench.store import BIAS_VARIANCE, IDENTITY, write_whole

WHOLE = ("horizon", "samples", "repeats", "dim", "seed")
PROBLEM = ("scene", "contact", "integrator", "horizon", "dt", "stiffness", "sigma", "smoothing", "noise")
"""What rows must share for their times and errors to be comparable."""
PAGE_ROWS = 40
"""Rows up to which a LaTeX table fits a page."""
FOOTNOTES = [
    "0 (< u): the bias is not distinguishable from 0, its 95% interval reaches up to u.",
    "relative bias and rel. RMSE: divided by the norm of the reference gradient. A relative RMSE above 1 is worse "
    "than answering zero.",
    "variance: trace of the covariance of one estimate. time: one estimate, steady state, without compilation. "
    f"{UNSTEADY}: the interquartile range of its calls is over 20% of it; something else ran beside them.",
]


def write(rows: pd.DataFrame, directory: Path) -> list[Path]:
    """Write ``bias_variance`` (.csv, .md, .tex) and ``speed_accuracy.csv``; returns their paths."""
    table = readable(rows)
    contents = {
        "bias_variance.csv": _csv(rows.reindex(columns=list(BIAS_VARIANCE.names))),
        "bias_variance.md": markdown(table),
        "bias_variance.tex": latex(table),
        "speed_accuracy.csv": _csv(speed_accuracy(rows)),
    }
    for name, text in contents.items():
        write_whole(directory / name, text.encode())
    return [directory / name for name in contents]


def _csv(table: pd.DataFrame) -> str:
    whole = [name for name in WHOLE if name in table and (table[name].dropna() % 1 == 0).all()]
    return table.astype(dict.fromkeys(whole, "Int64")).to_csv(index=False, lineterminator="\n")


def speed_accuracy(rows: pd.DataFrame) -> pd.DataFrame:
    """Error against time, with ``pareto`` where no other good row of the same problem is both faster and more accurate."""
    results = ["rmse_rel", "bias_rel", "time_s", "time_iqr_s", "compile_s", "rollouts", "gradients"]
    table = rows[["experiment", *IDENTITY, "status", *results]].assign(pareto=False)
    good = table[(table["status"] == "ok") & np.isfinite(table["rmse_rel"]) & np.isfinite(table["time_s"])]
    for _, part in good.groupby(list(PROBLEM), dropna=False):
        table.loc[part.index[pareto(part["time_s"], part["rmse_rel"])], "pareto"] = True
    return table


@dataclass(frozen=True)
class Readable:
    """The main table as text, not yet escaped for any format."""

    title: str
    shared: list[str]
    headers: list[str]
    numeric: list[bool]
    """Of each column, whether it holds numbers."""
    body: list[list[str]]
    reasons: list[str]
    best: list[bool]
    """Of each row, whether its error is the lowest of its problem beyond the intervals."""


def readable(rows: pd.DataFrame) -> Readable:
    """The main table: identity columns that vary, the results, and for what failed its status and reason."""
    varying, shared = _varying(rows)
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
        numeric=[*(c in (*NUMBERS, "seed") for c in varying), *(True for _ in results), *(False for _ in status)],
        body=body,
        reasons=[f"({i}) {text}" for text, i in reasons.items()],
        best=best(rows).tolist(),
    )


def best(rows: pd.DataFrame) -> pd.Series:
    """Of each row, whether its RMSE is the lowest of its problem and apart from that of every other estimator.

    The interval of an RMSE goes from the lower to the upper ends of bias and variance, RMSE^2 = bias^2 + variance.
    """
    low, high = (np.sqrt(rows[f"bias_{end}"] ** 2 + rows.get(f"variance_{end}", math.nan)) for end in ("low", "high"))
    estimator = rows["estimator"] + "[" + rows["estimator_params"] + "]"
    ends = pd.DataFrame({"low": low, "high": high, "estimator": estimator, "rmse": rows["rmse"]})
    found = pd.Series(False, index=rows.index)
    for _, part in ends[rows["status"] == "ok"].groupby([rows[name] for name in (*PROBLEM, "samples")], dropna=False):
        first = part.loc[part["rmse"].idxmin()] if part["rmse"].notna().any() else None
        if first is not None:
            others = part[part["estimator"] != first["estimator"]]
            mine = part[part["estimator"] == first["estimator"]]
            if len(others) and mine["high"].max() < others["low"].min() and others["low"].notna().all():
                found[mine.index] = True
    return found


def _varying(rows: pd.DataFrame) -> tuple[list[str], list[str]]:
    """The identity columns to show, and sentences with the values of the others."""
    varying = [c for c in IDENTITY if rows[c].nunique(dropna=False) > 1]
    problems = rows.groupby(["scene", "contact"], sort=False)
    main = ("scene", "contact", "backend", "estimator", "estimator_params")
    implied = [c for c in varying if c not in main and (problems[c].nunique(dropna=False) == 1).all()]
    shared = [f"The same in every row: {_named(rows.iloc[0], [c for c in IDENTITY if c not in varying])}."]
    for (scene, contact), part in problems:
        if named := _named(part.iloc[0], implied):
            problem = f"{scene}, {contact}" if contact != "none" else str(scene)
            shared.append(f"In every row of {problem}: {named}.")
    return [c for c in varying if c not in implied], shared


def _named(row: Any, columns: Sequence[str]) -> str:
    texts = {c: _text(row[c]) for c in columns}
    return ", ".join(f"{c} {text}" for c, text in texts.items() if text not in ("", "none", "-"))


def _text(value: Any) -> str:
    return value if isinstance(value, str) else axis_value(value)


def _results(row: Any) -> list[str]:
    if row["status"] != "ok":
        return ["-"] * 6
    return [
        bias_text(row), bias_text(row, row["reference_norm"], interval=False),
        number(row["variance"], 3), number(row["rmse_rel"], 3), number(row["cosine"], 3),
        number(row["time_s"] * 1e3, 3) + UNSTEADY * bool(unsteady(row)),
    ]  # fmt: skip


def markdown(table: Readable) -> str:
    """The main table in Markdown."""
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
    """The main table in LaTeX: booktabs, numbers aligned by siunitx; a ``longtable`` where it would not fit a page.

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
        cells = [_latex_number(text) if form else e(text) for text, form in zip(row, formats, strict=True)]
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


NUMBER = re.compile(r"(-?)(\d+)(?:\.(\d+))?(?:e(-?)(\d+))?")
"""A number as tables print it: sign, whole and decimal digits, sign and digits of its exponent."""


def number_format(texts: Sequence[str]) -> str:
    """The ``table-format`` that holds all numbers of a column: ``-3.2e-1``."""
    found = [match.groups(default="") for match in map(NUMBER.fullmatch, texts) if match]
    if not found:
        return "1.0"
    sign, power_sign = ("-" if any(parts[i] for parts in found) else "" for i in (0, 3))
    whole, decimals, power = (max(len(parts[i]) for parts in found) for i in (1, 2, 4))
    return f"{sign}{whole}" + (f".{decimals}" if decimals else "") + (f"e{power_sign}{power}" if power else "")


def _latex_number(text: str) -> str:
    """A number for siunitx to align; what is none in braces."""
    return text if NUMBER.fullmatch(text) else f"{{{escape_latex(text)}}}"


def plain_markdown(table: pd.DataFrame, heads: Mapping[str, str] = MappingProxyType({})) -> str:
    """A table of texts in Markdown; ``heads`` are columns' headings where their names do not say it."""
    out = ["| " + " | ".join(heads.get(name, name) for name in table) + " |", "|" + "---|" * table.shape[1]]
    out += ["| " + " | ".join(map(escape_markdown, map(str, row))) + " |" for row in table.fillna("").to_numpy()]
    return "\n".join(out)


def escape_markdown(text: str) -> str:
    """Text that a Markdown renderer shows as it stands, in a table cell too."""
    text = one_line(text).replace("&", "&amp;")
    text = re.sub(r"<(?! )", "&lt;", text).replace(">", "&gt;")
    text = re.sub(r"([\\`*|$~])", r"\\\1", text).replace("](", r"]\(")
    return re.sub(r"(?<!\w)_|_(?!\w)", r"\\_", text)


def escape_latex(text: str) -> str:
    """Text that LaTeX prints as it stands."""
    special = {c: rf"\{c}" for c in "&%$#_{}"} | {
        "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$",
        "|": "$|$", "[": "{[}", "]": "{]}",
    }  # fmt: skip
    return "".join(special.get(c, c) for c in one_line(text))


def one_line(text: str) -> str:
    """Text without line breaks and control characters."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
