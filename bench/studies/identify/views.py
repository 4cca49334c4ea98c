"""What the study of fits shows: how well each shooting method estimates the parameters that a record identifies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import chi2

from bench.experiment.axes import table
from bench.experiment.columns import Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import parse
from bench.experiment.views import Chart, Mark, Style, Table, Views
from bench.model import registry
from bench.model.parameters import named
from bench.report.problems import problem_names
from bench.report.style import PALETTE
from bench.report.text import number
from bench.report.views import Arranged, arrange, attempted
from bench.report.writer import reasons
from bench.studies.identify.measure import is_minimum

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
    "with more identifiable directions than the record has. verdict: unconverged, fewer than 90% converge; narrow, intervals "
    "contain the truth less often than stated; precise, neither, and errors reach the bound. single: one rollout. multiple: windows whose ends must meet. "
    "windows: independent windows.",
)
SCANNED = (
    "local minima: values of the scan at which the loss is below that at both neighbours; all other unknowns have their own "
    "values, and windows start at the measurements. A count holds for its values: others, and for a chaotic record another "
    "rounding, give another.",
    "A window is compared with all samples after its start, its last one included, at which the next window starts. without "
    "the last sample: the same windows if that sample is not compared.",
)
CURVE, MINIMUM, FIT = "loss", "local minimum", "fit"


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the tables of fits and of identifiable parameters, and the charts of the fits' precision."""
    shown = arrange(experiment, rows)
    lines = flatten(shown)
    by_name = {
        column.name: replace(column, kind="number") if column.name in STATISTICS else column
        for column in experiment.columns.all
    }
    fits = [replace(by_name[name], digits=digits) for name, digits in (("converged", 2), ("error", 2), ("coverage", 2))]
    tables = [
        Table(
            "identify", lines, [PROBLEM, SHOOTING, text("verdict"), *fits, by_name["hidden"], by_name["fits"]],
            "fits of parameters to records of the motion", NOTES, terminal=True, page=True, data=table(experiment, rows),
        ),
        Table(
            "identify", lines.drop_duplicates("problem"),
            [PROBLEM, text("identifiable"), replace(by_name["bound"], kind="text"), replace(by_name["condition"], digits=3), by_name["explained"], by_name["step_note"]],
            "Parameters that a record identifies",
            ["identifiable: products of powers of the parameters. bound: Cramer-Rao bound of their relative standard deviations. explained: records that no test of the residuals contradicts."],
            terminal=True, details=["step_note"],
        ),
        Table("fits", lines.drop(columns="row"), [], files=["csv"]),
    ]  # fmt: skip
    scans = scanned(shown)
    if len(scans):
        one = by_name["scan_steps"]
        tables.append(
            Table(
                "identify",
                scans.drop(columns=["loss", "unit"]),
                [
                    PROBLEM,
                    text("unknown"),
                    Column("values", "values of the scan", format="setting"),
                    Column("from", format="setting"),
                    Column("to", format="setting"),
                    replace(one, name="steps", kind="number", label="window", unit="steps", format="setting"),
                    *(
                        replace(by_name[name], kind="number", format="setting", label=label)
                        for name, label in (("minima", "local minima"), ("minima_open", "without the last sample"))
                    ),
                ],
                "Local minima of the loss along each unknown",
                SCANNED,
                terminal=True,
                page=True,
            )
        )
    if lines.empty:
        return Views(tables[:1], remarks=reasons(rows))
    return Views(tables, [*charts(lines, fits, by_name), *scan_charts(scans)], remarks=reasons(rows))


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
    table_ = table_.assign(error_low=low, error_high=high)
    return table_.assign(verdict=verdicts(table_))


def error_interval(error: pd.Series, count: pd.Series) -> tuple[pd.Series, pd.Series]:
    """Return the 95% interval of a root mean square error over ``count`` independent normal errors.

    The count is the number of fits that converged: the errors of a fit's parameters are dependent.
    """
    n = np.maximum(np.round(count.astype(float)), 1.0)
    low, high = (error.astype(float) * np.sqrt(n / chi2.ppf(p, n)) for p in (0.975, 0.025))
    return low, high


def verdicts(lines: pd.DataFrame) -> np.ndarray:
    """Return a verdict per line, by intervals of 95%: see :data:`NOTES`."""
    is_precise = (lines["converged_low"] >= CONVERGED) & (lines["error_low"] <= 1.0) & (lines["error_high"] < 2.0)
    kinds = {
        "unconverged": lines["converged_high"] < CONVERGED,
        "narrow": lines["coverage_high"] < LEVEL,
        "precise": is_precise & (lines["coverage_high"] >= LEVEL),
    }
    return np.select(list(kinds.values()), list(kinds), "open")


# ---------------------------------------------------------------------------------------------------------- scans


def scanned(shown: Arranged) -> pd.DataFrame:
    """Return one line per problem, unknown and window of a scan; ``loss`` has a number per value of the unknown.

    Rows that differ by optimizer or seed only have one scan each: the first is shown.
    """
    rows = attempted(shown.rows)
    rows = rows[rows["status"] == "ok"]
    if rows.empty or "scan_steps" not in rows:
        return pd.DataFrame()
    rows = rows[[isinstance(steps, list | np.ndarray) and len(steps) > 0 for steps in rows["scan_steps"]]]
    rows = rows.assign(problem=problem_names(shown, PARTS, rows=rows)).drop_duplicates("problem")
    lines = []
    for index, row, given in zip(rows.index, rows.to_dict("records"), parse(rows), strict=True):
        steps, names = list(row["scan_steps"]), list(row["unknowns"])
        losses = np.array(row["scan_loss"], dtype=float).reshape(len(names), len(steps), -1)
        for i, name in enumerate(names):
            for j, window in enumerate(steps):
                lines.append({
                    "row": index, "problem": row["problem"], "unknown": name, "unit": unit_of(name, given),
                    "values": losses.shape[2], "from": row["scan_low"][i], "to": row["scan_high"][i], "steps": window,
                    "minima": row["minima"][i * len(steps) + j], "minima_open": row["minima_open"][i * len(steps) + j],
                    "truth": row["truth"][i], "fit": fitted(row, name, {len(steps) - 1: "windows", 0: "single"}.get(j, "")),
                    "is_own": bool((given.get("study") or {}).get("data")), "loss": losses[i, j],
                })  # fmt: skip
    return pd.DataFrame(lines)


def fitted(row: Mapping[str, Any], unknown: str, shooting: str) -> float:
    """Return the value that a shooting method gave an unknown in the first record; NaN if only a product with it is identifiable."""
    methods, invariants = list(row["shooting"]), list(row["invariants"])
    if shooting not in methods or unknown not in invariants:
        return np.nan
    return float(row["first"][methods.index(shooting) * len(invariants) + invariants.index(unknown)])


def unit_of(name: str, given: Mapping[str, Any]) -> str:
    """Return the unit of an unknown, from the plugins of its row; empty if they are not installed."""
    entries = [
        registry.entries().get(kind, {}).get(str((given.get(axis) or {}).get("name")))
        for axis, kind in (("scene", "scenes"), ("contact", "contacts"))
    ]
    declared = named([entry.plugin for entry in entries if entry is not None and entry.plugin is not None], name)
    return declared.unit if declared is not None else ""


def _each(scans: pd.DataFrame) -> list[pd.DataFrame]:
    """Return the lines of each scan, the whole record first."""
    return [scan for _, scan in scans.groupby(["problem", "unknown"], sort=False)]


def scan_charts(scans: pd.DataFrame) -> list[Chart]:
    """Return a chart of the loss along each unknown: a panel per window, with its local minima, the truth and the fit."""
    names: dict[str, int] = {}
    drawn = []
    for scan in _each(scans) if len(scans) else ():
        unknown = scan["unknown"].iloc[0]
        names[unknown] = names.get(unknown, 0) + 1
        drawn.append(_scan_chart(scan, f"scan_{unknown}" + (f"_{names[unknown]}" if names[unknown] > 1 else "")))
    return drawn


def _scan_chart(scan: pd.DataFrame, name: str) -> Chart:
    one, parts = scan.iloc[0], []
    for line in scan.to_dict("records"):
        loss = np.where(np.isfinite(line["loss"]), line["loss"], np.nan)
        values = np.linspace(line["from"], line["to"], len(loss))
        whole = line["steps"] == one["steps"]
        panel = f"{'whole record' if whole else 'windows'} of {line['steps']} steps: {line['minima']:.0f} {'minimum' if line['minima'] == 1 else 'minima'}"
        curve = pd.DataFrame({"value": values, "loss": loss, "part": CURVE, "window": panel, "row": line["row"]})
        parts += [curve, curve[is_minimum(loss)].assign(part=MINIMUM)]
        if line["from"] <= line["fit"] <= line["to"]:
            parts.append(curve[:1].assign(value=line["fit"], loss=np.interp(line["fit"], values, loss), part=FIT))
    return Chart(
        name, pd.concat(parts, ignore_index=True),
        [Column("value", label=str(one["unknown"]), unit=str(one["unit"]), log=False)],
        [Column("loss", label="mean square of residual / noise", log=True)],
        "lines", series="part", panel="window", across=3, height=1.9, labels="legend",
        styles={CURVE: Style(PALETTE[0], "", width=0.8), MINIMUM: Style(PALETTE[1], ".", line="none"), FIT: Style(PALETTE[2], "D", line="none")},
        marks=[Mark("scene" if one["is_own"] else "truth", one["truth"]), Mark("", 1.0, axis="y")],
        subtitle="grey line: 1, the noise of a sample; fit: of the first record",
        text="The loss along one unknown, all others at their own values. Windows start at the measurements.",
    )  # fmt: skip


# --------------------------------------------------------------------------------------------------------- charts


def charts(lines: pd.DataFrame, fits: Sequence[Column], by_name: dict[str, Column]) -> list[Chart]:
    """Return the chart of errors and coverage for print, and the chart of any two numbers for the page."""
    styles = {
        name: Style(PALETTE[i], "osD"[i % 3]) for i, name in enumerate(dict.fromkeys(lines["shooting"]))
    }  # fmt: skip
    order = (lines["verdict"] == "precise").groupby(lines["integrator"]).mean()
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
            "identify", pd.concat(parts, ignore_index=True), [x], [text("problem", label="")], "dots", series="shooting",
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
            "fits", frame, known, [text("problem", label="")], "dots", series="shooting", styles=styles, printed=False,
            text="One dot per problem and shooting method. Choose the quantity.",
        ),
    ]  # fmt: skip
