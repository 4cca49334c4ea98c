"""What the study of fits shows: how well each shooting method estimates the parameters that a record identifies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.stats import chi2

from bench.experiment.axes import table
from bench.experiment.columns import Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Mark, Style, Table, Views
from bench.report.problems import problem_names
from bench.report.style import PALETTE
from bench.report.text import counted, number
from bench.report.views import Arranged, arrange, attempted
from bench.report.writer import reasons

PARTS = ("scene", "contact", "integrator")
STATISTICS = (
    "converged", "converged_low", "converged_high", "error", "coverage", "coverage_low", "coverage_high", "hidden",
)  # fmt: skip
"""Columns with one value per shooting method."""
LEVEL, CONVERGED = 0.95, 0.9
"""Stated coverage of the intervals, and the least share of fits that have to converge."""
PROBLEM, SHOOTING = text("problem"), text("shooting")
NOTES = (
    "converged: fits whose residuals are consistent with the noise. error: root mean square error of converged fits in "
    "units of the Cramer-Rao bound, at best 1. coverage: share of their 95% intervals that contain the truth. hidden: fits "
    "with more identifiable directions than the record has. single: one rollout. multiple: windows whose ends must meet. "
    "windows: independent windows.",
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the findings, the tables of fits and of identifiable parameters, and the charts of the fits' precision."""
    shown = arrange(experiment, rows)
    lines = flatten(shown)
    by_name = {
        column.name: replace(column, kind="number") if column.name in STATISTICS else column
        for column in experiment.columns.all
    }
    fits = [replace(by_name[name], digits=digits) for name, digits in (("converged", 2), ("error", 2), ("coverage", 2))]
    tables = [
        Table(
            "identify", lines, [PROBLEM, SHOOTING, *fits, by_name["hidden"], by_name["fits"]],
            "fits of parameters to records of the motion", NOTES, terminal=True, page=True, data=table(experiment, rows),
        ),
        Table(
            "identify", lines.drop_duplicates("problem"),
            [PROBLEM, text("identifiable"), replace(by_name["bound"], kind="text"), replace(by_name["condition"], digits=3), by_name["explained"], by_name["step_note"]],
            "Parameters that a record identifies",
            ["identifiable: products of powers of the parameters. bound: Cramer-Rao bound of their relative standard deviations. explained: records that no test of the residuals contradicts."],
            terminal=True, details=["step_note"],
        ),
    ]  # fmt: skip
    if lines.empty:
        return Views(["No fit gave a result: the table has the reason of each."], tables[:1], remarks=reasons(rows))
    texts = findings(lines)
    return Views(texts, tables, charts(lines, fits, by_name, texts[0]), remarks=reasons(rows))


def flatten(shown: Arranged) -> pd.DataFrame:
    """Return one line per problem, optimizer, seed and shooting method; ``row`` is the position of the cell."""
    rows = attempted(shown.rows)
    rows = rows[rows["status"] == "ok"]
    names = problem_names(shown, PARTS, rows=rows)
    names = names + (", " + rows["optimizer"] if rows["optimizer"].nunique() > 1 else "")
    lines = []
    for index, name, row in zip(rows.index, names, rows.to_dict("records"), strict=True):
        for i, shooting in enumerate(row["shooting"]):
            lines.append({
                "row": index, "problem": name, "scene": row["scene"], "integrator": row["integrator"], "shooting": shooting,
                "identifiable": ", ".join(row["invariants"]), "rank": row["rank"], "n_unknowns": len(row["unknowns"]),
                "bound": ", ".join(number(b) for b in row["bound"]), "condition": row["condition"], "fits": row["fits"],
                "step_note": row["step_note"], "explained": row["explained"], "step_shift": row["step_shift"],
                **{column: float(row[column][i]) for column in STATISTICS},
            })  # fmt: skip
    names_ = [
        "row",
        "problem",
        "shooting",
        "identifiable",
        "bound",
        "condition",
        "fits",
        "step_note",
        "explained",
        *STATISTICS,
    ]
    table_ = pd.DataFrame(lines) if lines else pd.DataFrame(columns=names_)
    low, high = error_interval(table_["error"], table_["converged"] * table_["fits"])
    return table_.assign(error_low=low, error_high=high)


def error_interval(error: pd.Series, count: pd.Series) -> tuple[pd.Series, pd.Series]:
    """Return the 95% interval of a root mean square error over ``count`` independent normal errors.

    The count is the number of fits that converged: the errors of a fit's parameters are dependent.
    """
    n = np.maximum(np.round(count.astype(float)), 1.0)
    low, high = (error.astype(float) * np.sqrt(n / chi2.ppf(p, n)) for p in (0.975, 0.025))
    return low, high


# ------------------------------------------------------------------------------------------------------- findings


def unconverged(lines: pd.DataFrame) -> pd.Series:
    """Return a mask of the lines where fewer than 90% of the fits converge, with 95% confidence."""
    return lines["converged_high"] < CONVERGED


def narrow(lines: pd.DataFrame) -> pd.Series:
    """Return a mask of the lines whose intervals contain the truth less often than stated, with 95% confidence."""
    return lines["coverage_high"] < LEVEL


def precise(lines: pd.DataFrame) -> pd.Series:
    """Return a mask of the lines where at least 90% converge, and errors and coverage agree with the bound, by intervals."""
    reaches = (lines["error_low"] <= 1.0) & (lines["error_high"] < 2.0)
    return (lines["converged_low"] >= CONVERGED) & reaches & (lines["coverage_high"] >= LEVEL)


def findings(lines: pd.DataFrame) -> list[str]:
    """Return which integrator and shooting method to use, where fits or their intervals fail, and what is hidden."""
    lines = lines.assign(precise=precise(lines))
    keys = ["integrator", "shooting"] if lines["integrator"].nunique() > 1 else ["shooting"]
    record = lines.groupby(keys, sort=False)["precise"].agg(["sum", "size"])
    record = record.assign(share=record["sum"] / record["size"])
    best = record.sort_values(["share", "size"], ascending=False, kind="stable").iloc[0]
    texts = []
    if best["sum"]:
        name = best.name if isinstance(best.name, tuple) else (best.name,)
        mine = lines[(lines[keys] == list(name)).all(axis=1) & lines["precise"]]
        means = " and ".join([*name[:-1], f"{name[-1]} shooting"])
        texts.append(
            f"Use {means}: in {best['sum']:.0f} of {counted(int(best['size']), 'case')} fits converge and reach the "
            f"Cramer-Rao bound (error {_range(mine['error'])} times the bound)."
        )
    else:
        texts.append("No fit is known to reach the Cramer-Rao bound.")
    return [*texts, *filter(None, (_failures(lines), _hidden(lines)))]


def _failures(lines: pd.DataFrame) -> str:
    """Return where fits do not explain the records, and where intervals are too narrow."""
    lost, wrong = lines[unconverged(lines)], lines[narrow(lines)]
    parts = []
    if len(lost):
        parts.append(
            f"fits do not explain the record in {len(lost)} of {counted(len(lines), 'case')}{_all_with(lost, lines)}"
        )
    if len(wrong):
        worst = wrong.loc[wrong["coverage"].idxmin()]
        parts.append(
            f"95% intervals are too narrow in {len(wrong)} (they contain the truth in {worst['coverage']:.0%} of the fits of "
            f"{worst['problem']}, {worst['shooting']} shooting)"
        )
    if not parts:
        return f"Neither fits nor their intervals fail in any of {counted(len(lines), 'case')}."
    texts = " and ".join(parts) if len(lost) else f"{parts[0]} of {counted(len(lines), 'case')}"
    return f"{texts[:1].upper()}{texts[1:]}."


def _all_with(part: pd.DataFrame, lines: pd.DataFrame) -> str:
    """Return ``, all with NAME`` if only one of several integrators is concerned."""
    names = part["integrator"].unique()
    return f", all with {names[0]}," if len(names) == 1 < lines["integrator"].nunique() else ""


def _hidden(lines: pd.DataFrame) -> str:
    """Return the problems whose parameters are not all identifiable, and fits that report more than the record has."""
    few = lines[lines["rank"] < lines["n_unknowns"]].drop_duplicates("scene")
    parts = [
        f"{row['scene']} identifies only {' and '.join(row['identifiable'].rsplit(', ', 1)) or 'no parameter'}"
        for row in few.to_dict("records")
    ]
    count = int(lines["hidden"].sum())
    if count:
        parts.append(
            f"{count} of {int(lines['fits'].sum())} fits report more identifiable directions than the record has"
        )
    text_ = " and ".join(parts)
    return f"A record of {text_}." if few.size else f"{text_}." if text_ else ""


def _range(values: pd.Series) -> str:
    low, high = number(values.min()), number(values.max())
    return low if low == high else f"{low} to {high}"


# --------------------------------------------------------------------------------------------------------- charts


def charts(lines: pd.DataFrame, fits: Sequence[Column], by_name: dict[str, Column], title: str) -> list[Chart]:
    """Return the chart of errors and coverage for print, and the chart of any two numbers for the page."""
    styles = {
        name: Style(PALETTE[i], "osD"[i % 3]) for i, name in enumerate(dict.fromkeys(lines["shooting"]))
    }  # fmt: skip
    order = lines.assign(precise=precise(lines)).groupby("integrator")["precise"].mean()
    lines = lines.iloc[(-lines["integrator"].map(order)).argsort(kind="stable")]
    parts, marks = [], []
    for column, ideal, name in ((fits[1], 1.0, "bound"), (fits[2], LEVEL, "")):
        if lines[column.name].notna().any():
            values = {end: lines[c] for end, c in (("value", column.name), ("low", column.low), ("high", column.high))}
            parts.append(lines.assign(**values, panel=column.heading, failed=lines["converged"] == 0))
            marks.append(Mark(name, ideal, panel=column.heading))
    x = Column("value", label=" ", low="low", high="high")
    drawn = [] if not parts else [
        Chart(
            "identify", title, pd.concat(parts, ignore_index=True), [x], [text("problem", label="")], "dots", series="shooting",
            panel="panel", styles=styles, marks=marks, failed="failed", own_scales=True, across=2, height=0.34, on_page=False,
            subtitle="a cross: no fit converges",
        )
    ]  # fmt: skip
    quantities = [fits[1], fits[0], fits[2], by_name["condition"], by_name["step_shift"]]
    known = [column for column in quantities if lines[column.name].notna().any()]
    frame = lines.drop_duplicates(["row", "shooting"])
    return [
        *drawn,
        Chart(
            "fits", title, frame, known, [text("problem", label="")], "dots", series="shooting", styles=styles, printed=False,
            text="One dot per problem and shooting method. Choose the quantity.",
        ),
    ]  # fmt: skip
