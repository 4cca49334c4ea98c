"""What the study of fits shows: how well each shooting method estimates the parameters that a record identifies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import chi2

from bench.experiment.axes import table
from bench.experiment.columns import Column, interval, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Mark, Table, Views
from bench.report.shown import Shown, stacked

STATISTICS = (
    "converged",
    "converged_low",
    "converged_high",
    "error",
    "coverage",
    "coverage_low",
    "coverage_high",
    "hidden",
)
"""Columns with one value per shooting method."""
LEVEL, CONVERGED = 0.95, 0.9
"""Stated coverage of the intervals, and the least share of fits that have to converge."""
MAX_STEP_SHIFT = 0.5
"""Largest change of an estimate at half the step, in Cramer-Rao bounds, that counts as independent of the step.

To first order in the step, the error of the estimate is twice this change: one bound. With a bias of one bound, 17% of
the 95% intervals miss the truth instead of 5%.
"""
ESTIMATED = ("parameter", "estimate", "estimate_low", "estimate_high", "bias", "unit", "identifiable", "start")
BIASED = ("biased", "term", "unnoticed", "errors")
"""Columns with lists whose entries are lines of a table."""
ESTIMATES = (
    "estimate: of the first record, by one rollout. low, high: its 95% interval. seen: whether the record identifies the parameter; product: "
    "only products with it. bias: the largest that a term of the next table can cause, to first order, while 5% of "
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


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the tables of estimates, of what records cannot show and of fits, and the charts of the fits' precision."""
    given = Shown(experiment, rows).good
    # rows of older versions lack the columns
    given = given[given["parameter"].map(np.ndim) > 0]
    doubts = {
        "unfinished": [values[0] < 1.0 for values in given["optimum"]],
        "not explained": given["contradictions"] != "",
        "untested": given["explained"].isna(),
        "time step": given["step_shift_bound"] > MAX_STEP_SHIFT,
    }
    given = given.assign(
        problem=given["problem"] + (", " + given["optimizer"] if given["optimizer"].nunique() > 1 else ""),
        doubt=[
            ", ".join(name for name, holds in zip(doubts, row, strict=True) if holds)
            for row in zip(*doubts.values(), strict=True)
        ],
    )
    words = ("shooting", "parameter", "unit", "identifiable", "biased", "term")
    kinds: dict[str, Any] = {"list": "number"} | dict.fromkeys(words, "text")
    by_name = {c.name: replace(c, kind=kinds.get(c.name, kinds.get(c.kind, c.kind))) for c in experiment.columns.all}
    by_name |= {name: text(name) for name in ("problem", "doubt", "verdict")}

    def columns(*names: str) -> list[Column]:
        return [by_name[name] for name in names]

    lines, found = fits_of(given), exploded(given, ["doubt"], ESTIMATED)
    hidden = exploded(given, [], BIASED).sort_values("errors", ascending=False, ignore_index=True)
    split = "problem" if len(given) > 1 else ""
    tables = [
        Table(
            "identify",
            found,
            columns(*ESTIMATED[:5], *["doubt"] * bool(found["doubt"].any()), *ESTIMATED[5:]),
            "Estimates",
            ESTIMATES,
            terminal=True,
            page=True,
            split=split,
            data=table(experiment, rows),
        ),
        Table(
            "identify",
            hidden[hidden["errors"] > 1.0],
            columns(*BIASED),
            "What a record cannot show",
            UNNOTICED,
            terminal=not split,
            split=split,
        ),
        Table(
            "identify",
            given,
            columns(
                "problem",
                "explained",
                "contradictions",
                "interval_noise",
                "noise_size",
                "step_shift_bound",
                "condition",
            ),
            "Records",
            RECORDS,
            terminal=True,
        ),
        Table(
            "identify",
            lines,
            columns("problem", "shooting", "verdict", "converged", "error", "coverage", "hidden", "fits"),
            "Fits",
            NOTES,
            terminal=True,
        ),
        *(Table(name, frame) for name, frame in (("estimates", found), ("unnoticed", hidden), ("fits", lines))),
    ]
    if lines.empty:
        return Views(tables[:1])
    return Views(tables, charts(lines, columns("error", "coverage")))


def exploded(rows: pd.DataFrame, kept: Sequence[str], lists: Sequence[str]) -> pd.DataFrame:
    """Return a line per entry of the columns ``lists``, with its problem and the columns ``kept``."""
    lines = rows[["problem", *kept, *lists]].explode([*lists], ignore_index=True)
    return lines.dropna(subset=[lists[0]]).infer_objects()


def fits_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one line per problem, optimizer, seed and shooting method."""
    lines = exploded(rows, ["scene", "integrator", "condition", "fits", "explained"], ["shooting", *STATISTICS])
    low, high = error_interval(lines["error"], lines["converged"] * lines["fits"])
    lines = lines.assign(error_low=low, error_high=high)
    return lines.assign(verdict=verdicts(lines))


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


# --------------------------------------------------------------------------------------------------------- charts


def charts(lines: pd.DataFrame, fits: Sequence[Column]) -> list[Chart]:
    """Return the chart of errors and coverage, or none if no truth is known."""
    drawn = {column.heading: column.name for column in fits if lines[column.name].notna().any()}
    if not drawn:
        return []
    names = {"single": "single shooting", "multiple": "multiple shooting", "windows": "independent windows"}
    frame = stacked(lines.assign(shooting=lines["shooting"].map(names)), drawn, "value")
    ideals = zip(fits, (1.0, LEVEL), ("Cramer-Rao bound", f"stated, {LEVEL:.0%}"), strict=True)
    marks = [Mark(name, ideal, panel=column.heading) for column, ideal, name in ideals]
    frame = frame.assign(failed=(frame["converged"] == 0) & (frame["series"] == fits[0].heading))
    return [
        Chart(
            "identify",
            frame,
            [interval("value", label=" ")],
            [text("problem", label="")],
            "dots",
            series="shooting",
            panel="series",
            marks=marks,
            failed="failed",
            failed_name="no fit converges",
            own_scales=True,
            across=2,
            subtitle=f"{lines['fits'].max():g} noisy records of each; windows need a measurement after each step",
        )
    ]
