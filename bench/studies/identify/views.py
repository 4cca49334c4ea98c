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
from bench.measure.identification import product
from bench.measure.performance import Z
from bench.report.problems import problem_names
from bench.report.style import PALETTE
from bench.report.views import arrange, attempted
from bench.studies.identify.measure import is_minimum

PARTS = ("scene", "contact", "integrator")
STATISTICS = (
    "converged", "converged_low", "converged_high", "error", "coverage", "coverage_low", "coverage_high", "hidden",
)  # fmt: skip
"""Columns with one value per shooting method."""
LEVEL, CONVERGED = 0.95, 0.9
"""Stated coverage of the intervals, and the least share of fits that have to converge."""
MAX_STEP_SHIFT = 0.5
"""Largest change of an estimate at half the step, in Cramer-Rao bounds, that counts as independent of the step.

To first order in the step, the error of the estimate is twice this change: one bound. With a bias of one bound, 17% of
the 95% intervals miss the truth instead of 5%.
"""
DIGITS = 4
"""Significant digits of estimates."""
PROBLEM, SHOOTING, PARAMETER = text("problem"), text("shooting"), text("parameter")
BIAS = Column("bias", label="unseen bias")
ESTIMATES = (
    "estimate: of the first record, by one rollout. low, high: its 95% interval. identified: a parameter that is not has no estimate; in "
    "products: only products with it are. unseen bias: the largest that a term of the next table can cause, to first order, while 5% of "
    "records do not show it. doubt: unfinished, no optimum was reached; not explained, the residuals contradict the model; untested, too "
    "few measurements for a test; time step, halving it moves the estimate by more than half its standard error.",
)
UNNOTICED = (
    "Terms that the model lacks, and the largest bias that each causes while 5% of records do not show it; above one standard "
    "error only. inf: no record of this motion shows the term.",
)
RECORDS = (
    "explained: records that no test of the residuals contradicts. intervals: noise that they allow for, by tests of the "
    "residuals: of the stated size, of the residuals' own size, or correlated from step to step. step shift bound: change of an "
    "estimate when the step is halved, in units of its Cramer-Rao bound. contradictions: of the first record, with their sizes.",
)
NOTES = (
    "converged: fits whose residuals are consistent with the noise. error: root mean square error of converged fits in "
    "units of the Cramer-Rao bound, at best 1. coverage: share of their 95% intervals that contain the truth. hidden: fits "
    "with more identifiable directions than the record has. verdict: unconverged, fewer than 90% converge; narrow, intervals "
    "contain the truth less often than stated; precise, neither, and errors reach the bound. single: one rollout. multiple: windows whose ends must meet. "
    "windows: independent windows.",
)
SCANNED = (
    "steps: length of a window. minima: values of the scan at which the loss is below that at both neighbours; all other unknowns have their own "
    "values, and windows start at the measurements. A count holds for its values: others, and for a chaotic record another "
    "rounding, give another.",
    "A window is compared with all samples after its start, its last one included, at which the next window starts. minima "
    "open: the same windows if that sample is not compared.",
)
CURVE, MINIMUM = "loss", "local minimum"


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the tables of estimates, of what records cannot show and of fits, and the charts of the fits' precision."""
    shown = arrange(experiment, rows)
    given = attempted(shown.rows)
    # rows of older versions lack the columns
    given = given[(given["status"] == "ok") & (given["units"].map(np.ndim) > 0)]
    names = problem_names(shown, PARTS, rows=given)
    given = given.assign(
        scan=names, intervals=[values[0] for values in given["intervals"]],
        problem=names + (", " + given["optimizer"] if given["optimizer"].nunique() > 1 else ""),
    )  # fmt: skip
    by_name = {c.name: replace(c, kind="number") if c.name in STATISTICS else c for c in experiment.columns.all}
    fits = [by_name[name] for name in ("converged", "error", "coverage")]
    lines, found, hidden = fits_of(given), estimates(given), unnoticed(given)
    split = "problem" if len(given) > 1 else ""
    tables = [
        Table(
            "identify", found,
            [PARAMETER, *(Column(name, digits=DIGITS) for name in ("estimate", "low", "high")), BIAS, text("doubt"), text("unit"),
             text("identifiable", label="identified"), Column("start", format="setting")],
            "Estimates", ESTIMATES, terminal=True, page=True, split=split, data=table(experiment, rows),
        ),
        Table(
            "identify", hidden[hidden["errors"] > 1.0],
            [PARAMETER, text("term"), BIAS, Column("errors", label="in standard errors")],
            "What a record cannot show", UNNOTICED, terminal=not split, page=True, split=split,
        ),
        Table(
            "identify", given,
            [PROBLEM, by_name["explained"], by_name["contradictions"], text("intervals"), by_name["noise_size"],
             by_name["step_shift_bound"], by_name["condition"]],
            "Records", RECORDS, terminal=True, page=True,
        ),
        Table(
            "identify", lines, [PROBLEM, SHOOTING, text("verdict"), *fits, by_name["hidden"], by_name["fits"]],
            "Fits", NOTES, terminal=True, page=True,
        ),
        Table("estimates", found, [], files=["csv"]),
        Table("unnoticed", hidden, [], files=["csv"]),
        Table("fits", lines, [], files=["csv"]),
    ]  # fmt: skip
    scans = scanned(given)
    if len(scans):
        settings = ("values", "from", "to", "steps", "minima", "minima_open")
        columns = [PROBLEM, text("unknown"), *(Column(name, format="setting") for name in settings)]
        tables.append(
            Table(
                "identify", scans.drop(columns=["loss", "unit"]), columns, "Local minima of the loss along each unknown",
                SCANNED, terminal=True, page=True,
            )
        )  # fmt: skip
    if lines.empty:
        return Views(tables[:1])
    return Views(tables, [*charts(lines, fits), *scan_charts(scans)])


def fits_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per problem, optimizer, seed and shooting method."""
    kept = ["problem", "scene", "integrator", "condition", "fits", "explained"]
    lines = rows[[*kept, "shooting", *STATISTICS]].explode(["shooting", *STATISTICS], ignore_index=True)
    lines = lines.astype(dict.fromkeys(STATISTICS, float))
    low, high = error_interval(lines["error"], lines["converged"] * lines["fits"])
    lines = lines.assign(error_low=low, error_high=high)
    return lines.assign(verdict=verdicts(lines))


def estimates(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per problem and identifiable product, and one per parameter that is not identifiable."""
    lines = []
    for row in rows.to_dict("records"):
        unknowns, invariants = list(row["unknowns"]), list(row["invariants"])
        doubts = {
            "unfinished": row["optimum"][0] < 1.0, "not explained": row["contradictions"] != "",
            "untested": np.isnan(row["misfit"]), "time step": row["step_shift_bound"] > MAX_STEP_SHIFT,
        }  # fmt: skip
        exponents = np.reshape(row["exponents"], (-1, len(unknowns)))
        units = tuple(f"({unit})" if " " in unit or "/" in unit else unit or "1" for unit in row["units"])
        for k, name in enumerate(dict.fromkeys([*invariants, *unknowns])):
            is_known = k < len(invariants)
            powers = exponents[k] if is_known else np.eye(len(unknowns))[unknowns.index(name)]
            ends = [row[column][k] if is_known else np.nan for column in ("estimate", "estimate_low", "estimate_high")]
            biases = np.reshape(row["unnoticed"], (len(invariants) or 1, -1))[k] if is_known else np.array(())
            lines.append({
                "problem": row["problem"], "parameter": name, **dict(zip(("estimate", "low", "high"), ends, strict=True)),
                "unit": row["units"][unknowns.index(name)] if name in unknowns else product(units, powers),
                "identifiable": "yes" if is_known else "in products" if (abs(exponents @ powers) > 1e-4).any() else "no",
                "start": np.prod(np.power(row["start"], powers)),
                "bias": biases.max() if biases.size else np.nan,
                "doubt": ", ".join(doubt for doubt, holds in doubts.items() if holds),
            })  # fmt: skip
    return pd.DataFrame(lines)


def unnoticed(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per problem, identifiable product and missing term, those of the largest biases first."""
    lines = []
    for row in rows.to_dict("records"):
        biases = np.reshape(row["unnoticed"], (-1, len(row["terms"]) or 1))
        for k, j in np.ndindex(biases.shape) if biases.size else ():
            width = row["estimate_high"][k] - row["estimate_low"][k]
            lines.append({
                "problem": row["problem"], "parameter": row["invariants"][k], "term": row["terms"][j],
                "bias": biases[k, j], "errors": biases[k, j] * 2.0 * Z / width,
            })  # fmt: skip
    table_ = pd.DataFrame(lines, columns=["problem", "parameter", "term", "bias", "errors"])
    return table_.sort_values("errors", ascending=False, ignore_index=True)


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


def scanned(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per problem, unknown and window of a scan; ``loss`` has a number per value of the unknown.

    Rows that differ by optimizer or seed only have one scan each: the first is shown.
    """
    rows = rows[[np.ndim(steps) * np.size(steps) > 0 for steps in rows["scan_steps"]]].drop_duplicates("scan")
    lines = []
    for row in rows.to_dict("records"):
        steps, names = list(row["scan_steps"]), list(row["unknowns"])
        losses = np.array(row["scan_loss"], dtype=float).reshape(len(names), len(steps), -1)
        for i, j in np.ndindex(losses.shape[:2]):
            lines.append({
                "problem": row["scan"], "unknown": names[i], "unit": row["units"][i],
                "values": losses.shape[2], "from": row["scan_low"][i], "to": row["scan_high"][i], "steps": steps[j],
                "minima": row["minima"][i * len(steps) + j], "minima_open": row["minima_open"][i * len(steps) + j],
                "truth": row["truth"][i],
                "loss": losses[i, j],
            })  # fmt: skip
    return pd.DataFrame(lines)


def scan_charts(scans: pd.DataFrame) -> list[Chart]:
    """Return a chart of the loss along each unknown: a panel per window, with its local minima and the truth."""
    charts_ = []
    for place, (_, every) in enumerate(scans.groupby("problem", sort=False) if len(scans) else ()):
        for unknown, scan in every.groupby("unknown", sort=False):
            one, parts = scan.iloc[0], []
            for line in scan.to_dict("records"):
                loss = np.where(np.isfinite(line["loss"]), line["loss"], np.nan)
                part = "whole record" if line["steps"] == one["steps"] else "windows"
                panel = f"{part} of {line['steps']} steps, local minima: {line['minima']:.0f}"
                values = np.linspace(line["from"], line["to"], len(loss))
                curve = pd.DataFrame({"value": values, "loss": loss, "part": CURVE, "window": panel})
                parts += [curve, curve[is_minimum(loss)].assign(part=MINIMUM)]
            charts_.append(Chart(
                f"scan_{unknown}" + f"_{place + 1}" * (place > 0), pd.concat(parts, ignore_index=True),
                [Column("value", label=str(unknown), unit=str(one["unit"]), log=False)],
                [Column("loss", label="mean square of residual / noise", log=True)],
                "lines", series="part", panel="window", across=3, height=1.9,
                styles={CURVE: Style(PALETTE[0], "", width=0.8), MINIMUM: Style(PALETTE[1], ".", line="none")},
                marks=[*([Mark("truth", one["truth"])] if np.isfinite(one["truth"]) else []), Mark("", 1.0, axis="y")],
                subtitle="grey line: 1, the noise of a sample",
                text="The loss along one unknown, all others at their own values. Windows start at the measurements.",
            ))  # fmt: skip
    return charts_


# --------------------------------------------------------------------------------------------------------- charts


def charts(lines: pd.DataFrame, fits: Sequence[Column]) -> list[Chart]:
    """Return the chart of errors and coverage, or none if no truth is known."""
    parts, marks = [], []
    for column, ideal, name in ((fits[1], 1.0, "bound"), (fits[2], LEVEL, "")):
        if lines[column.name].notna().any():
            values = {end: lines[c] for end, c in (("value", column.name), ("low", column.low), ("high", column.high))}
            parts.append(lines.assign(**values, panel=column.heading, failed=lines["converged"] == 0))
            marks.append(Mark(name, ideal, panel=column.heading))
    if not parts:
        return []
    return [
        Chart(
            "identify", pd.concat(parts, ignore_index=True), [Column("value", label=" ", low="low", high="high")],
            [text("problem", label="")], "dots", series="shooting", panel="panel", marks=marks, failed="failed",
            own_scales=True, across=2, height=0.34, subtitle="a cross: no fit converges",
        )
    ]  # fmt: skip
