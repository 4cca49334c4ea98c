"""Shows the results of claims: a chart per claim, the table of claims and that of their figures."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
import pandas as pd

from bench.claims.claim import VERDICTS, Claim, Figure
from bench.claims.discovery import LESSONS
from bench.claims.results import FAILED, ClaimResult
from bench.errors import printable
from bench.experiment.columns import Column, text
from bench.experiment.views import Chart, Mark, Style, Table
from bench.report.colours import estimator_colour, estimator_marker
from bench.report.tables import escape_markdown, plain_markdown
from bench.report.text import counted, duration, number

Results = Sequence[tuple[type[Claim], ClaimResult]]
TITLE = "Published claims, run again"
FIGURE = (
    text("claim"), text("figure"), text("published"), text("measured"), text("resolution", label="would fail at"),
    text("verdict"), text("lesson"),
)  # fmt: skip
"""Columns of the page's table of figures."""
NOTHING = Figure("", "0", math.nan)
"""Stands for the figures of a claim that has none, since its code failed."""
ESTIMATORS = {
    **dict.fromkeys(("first", "pathwise", "coarse"), "fobg"), **dict.fromkeys(("zeroth", "score"), "reinforce"),
    "measure-valued": "measure_valued", "gauss": "randomized_smoothing", "sphere": "sphere_smoothing",
}  # fmt: skip
"""Series that have the look of an estimator, with its name."""


def chart(claim: type[Claim], result: ClaimResult) -> Chart | None:
    """Return the chart of a claim from its stored series; None without a series."""
    if not (result.series and claim.curves):
        return None
    first, is_log, parts = next(iter(result.series)), {axis: axis in claim.logarithmic for axis in "xy"}, []
    x = pd.Series(result.series[first])
    for name, label in claim.curves.items():
        # a second column has the standard errors of means
        values = pd.DataFrame(np.reshape(result.series[name], (len(result.series[name]), -1))).reindex(columns=[0, 1])
        at = values.index if first in claim.curves else x
        low, high = (values[0] + side * 1.96 * values[1] for side in (-1, 1))
        parts.append(pd.DataFrame({
            "series": label, "x": at, "y": values[0], "low": np.maximum(low, 0.1 * values[0]) if is_log["y"] else low, "high": high,
        }))  # fmt: skip
    looks = {
        claim.curves[n]: Style(estimator_colour(e), estimator_marker(e))
        for n, e in ESTIMATORS.items()
        if n in claim.curves
    }
    return Chart(
        claim.name, pd.concat(parts, ignore_index=True), [Column("x", label=claim.labels[0], log=is_log["x"])],
        [Column("y", label=claim.labels[1], low="low", high="high", log=is_log["y"])], "lines",
        claim.learned.partition(". ")[0], "series", styles=looks, marks=[Mark(label, value, axis=axis) for axis, value, label in claim.marks],
        subtitle=f"{claim.name}, {claim.source.partition(';')[0]}: {result.verdict}",
    )  # fmt: skip


def measured_text(figure: Figure) -> str:
    """Return the measured number as text, with its 95% interval unless that is negligible."""
    value = number(figure.measured, 5)
    half = 1.96 * figure.error
    return f"{value} +- {number(half)}" if half > 1e-6 * abs(figure.measured) else value


def detectable_text(figure: Figure) -> str:
    """Return the smallest relative error that the figure detects, as text."""
    if figure.value == 0.0:
        return "any"
    if figure.detectable_error < 1e-3:
        return "<0.1%"
    return (
        f"{figure.detectable_error:.1%}" if figure.detectable_error < 1 else f"factor {1 + figure.detectable_error:.1f}"
    )


def insensitive_text(figures: Sequence[Figure]) -> str:
    """Return a sentence on how many figures cannot detect an error of 5%, and why; empty if all can."""
    limits = Counter(figure.limitation for figure in figures if figure.limitation)
    reasons = ", ".join(f"{count} for {limit}" for limit, count in limits.items())
    of_all = f"{limits.total()} of {counted(len(figures), 'figure')}"
    return f"{of_all} cannot detect an error of 5%: {reasons}" if limits else ""


def readable_figures(figures: Sequence[Figure]) -> pd.DataFrame:
    """Return the table of figures for readers: one row per figure, with every value as text."""
    return pd.DataFrame(
        {
            "figure": figure.what,
            "published": figure.published,
            "measured (95%)": measured_text(figure),
            "agrees": "yes" if figure.agrees else "NO",
            "would fail at": detectable_text(figure),
            "detects 5%": f"no: {figure.limitation}" if figure.limitation else "yes",
        }
        for figure in figures
    )


def figures_table(results: Results) -> pd.DataFrame:
    """Return the table of figures for programs: one row per figure, with every digit."""
    rows = [
        {
            "claim": claim.name, "lesson": claim.lesson, "source": claim.source, "figure": figure.what,
            "published": figure.published, "measured": figure.measured, "standard_error": figure.error,
            "slack": figure.tolerance, "agrees": figure.agrees, "resolution": figure.detectable_error,
            "sees_5_percent": figure.is_sensitive, "limited_by": figure.limitation,
            "verdict": result.verdict, "seconds": round(result.seconds, 2),
        }
        for claim, result in results
        for figure in result.figures or (NOTHING,)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def count_verdicts(results: Results) -> str:
    """Return the number of claims per verdict, as text."""
    tally = Counter(result.verdict for _, result in results)
    counts = ", ".join(f"{tally[verdict]} {verdict}" for verdict in (*VERDICTS, FAILED) if tally[verdict])
    return f"{counted(len(results), 'claim')}: {counts}"


def markdown(results: Results) -> str:
    """Return the verdicts and figures as Markdown, by lesson."""
    parts = [f"# {TITLE}\n\n{count_verdicts(results)}\n"]
    for lesson, own in groupby(results, lambda item: item[0].lesson):
        parts.append(f"## {lesson}\n\n{LESSONS.get(lesson, '')}\n")
        for claim, result in own:
            parts.append(f"### {claim.name}: {result.verdict}\n\n{claim.statement} ({claim.source})\n")
            if result.figures:
                parts.append(plain_markdown(readable_figures(result.figures)) + "\n")
            if result.remark:
                parts.append(f"*{escape_markdown(result.remark)}*\n")
            if sentence := insensitive_text(result.figures):
                parts.append(f"{sentence}.\n")
            parts.append(
                f"Learned: {claim.learned} `python -m bench claims {claim.name}`, {duration(result.seconds)}.\n"
            )
    return "\n".join(parts)


def claims_table(results: Results) -> Table:
    """Return a line per claim: its verdict, what it states, and the reservation or the reason of a failure."""
    lines = [
        (claim.lesson, claim.name, result.verdict, f"{claim.statement} ({claim.source})", result.remark)
        for claim, result in results
    ]
    names = ["lesson", "claim", "verdict", "statement", "remark"]
    frame = pd.DataFrame(lines, columns=names)
    return Table("claims", frame, [*map(text, names[1:])], "Claims", page=True, split="lesson")


def result_lines(claim: type[Claim], result: ClaimResult, is_stored: bool) -> Iterator[str]:
    """Yield the lines printed for one claim; that no figure detects an error of 5% stands first."""
    origin = ", as stored" if is_stored else ""
    blind = "detects no error of 5%: " if result.figures and all(f.limitation for f in result.figures) else ""
    yield (
        f"{claim.name:<4} {result.verdict:<29} {duration(result.seconds):>7}{origin}  {blind}{claim.source}: {claim.statement}"
    )
    for figure in result.figures:
        if not figure.agrees:
            yield f"       {figure.what}: published {figure.published}, measured {measured_text(figure)}"
    for sentence in filter(None, (result.remark, insensitive_text(result.figures))):
        yield f"       {sentence}"


def list_lines(claims: Sequence[type[Claim]]) -> Iterator[str]:
    """Yield the lines of ``--list``."""
    for lesson, own in groupby(claims, lambda claim: claim.lesson):
        yield printable(f"{lesson}: {LESSONS.get(lesson, '')}")
        for claim in own:
            quick = "quick" if claim.quick else "     "
            yield f"  {claim.name:<4} {quick}  {printable(f'{claim.statement} ({claim.source})')}"
