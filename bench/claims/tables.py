"""Shows the results of claims: a chart per claim, the table of claims and that of their figures."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np
import pandas as pd

from bench.claims.claim import VERDICTS, Claim, Figure
from bench.claims.discovery import LESSONS
from bench.claims.results import FAILED, ClaimResult
from bench.errors import printable
from bench.experiment.columns import Column, text
from bench.experiment.views import Chart, Mark, Table
from bench.report.cells import readable
from bench.report.colours import estimator_style, looks_by_name
from bench.report.tables import escape_markdown, plain_markdown
from bench.report.text import counted, duration, number

Results = Sequence[tuple[type[Claim], ClaimResult]]
TITLE = "Published claims, run again"
FIGURE = (
    text("figure"),
    text("published"),
    text("origin"),
    text("measured", label="measured (95%)"),
    text("status", label="verdict"),
    Column("resolution", label="would fail at, relative"),
    text("reason", label="5% not detected for"),
)
"""Columns of a table of figures for readers."""
NOTHING = Figure("", "0", math.nan)
"""Stands for the figures of a claim that has none, since its code failed."""
ESTIMATORS = {
    "first": "fobg",
    "pathwise": "fobg",
    "zeroth": "reinforce",
    "score": "reinforce",
    "measure": "measure_valued",
    "Gaussian": "randomized_smoothing",
    "sphere": "sphere_smoothing",
}
"""First words of the labels of curves that have the look of an estimator, with its name."""


def chart(claim: type[Claim], result: ClaimResult) -> Chart | None:
    """Return the chart of a claim from its stored series; None without a series."""
    if not result.series:
        return None
    (place, places), *curves = result.series.items()
    parts, styles = [], {}
    for label, series in curves:
        # a second column has the standard errors of means
        values = pd.DataFrame(np.reshape(series, (len(series), -1))).reindex(columns=[0, 1])
        low, high = (values[0] + side * 1.96 * values[1] for side in (-1, 1))
        parts.append(pd.DataFrame({"series": label, "x": places, "y": values[0], "low": low, "high": high}))
        if estimator := ESTIMATORS.get(re.split(r"\W", label)[0]):
            styles[label] = estimator_style(estimator)
    source, first = claim.source.partition(";")[0], re.split("[:;.] ", result.remark)[0]
    drawn = Chart(
        claim.name,
        pd.concat(parts, ignore_index=True),
        [Column("x", label=place, log="x" in claim.logarithmic)],
        [Column("y", label=claim.quantity, low="low", high="high", log="y" in claim.logarithmic)],
        "lines",
        claim.learned.partition(". ")[0],
        "series",
        styles=styles,
        marks=[Mark(label, value, axis=axis) for axis, value, label in claim.marks],
        subtitle=": ".join(filter(None, [f"{claim.name}, {source}: {result.verdict}", first])),
    )
    # what is named alike before a colon has one colour; of two curves on top of each other both are seen
    looks, heads = looks_by_name([drawn]), dict[str, str]()
    for i, (label, _) in enumerate(curves):
        head = heads.setdefault(label.partition(":")[0], label)
        styles[label] = replace(looks[head], line=["-", (0, (2, 2))][i % 2])
    return drawn


def measured_text(value: float, error: float) -> str:
    """Return a measured number as text, with its 95% interval unless that is negligible."""
    half = 1.96 * error
    return f"{number(value, 5)} +- {number(half)}" if half > 1e-6 * abs(value) else number(value, 5)


def for_readers(figures: pd.DataFrame) -> pd.DataFrame:
    """Return the table of figures with the columns :data:`FIGURE`."""
    return figures.assign(
        measured=[*map(measured_text, figures["measured"], figures["standard_error"])],
        status=figures["agrees"].map({True: "agrees", False: "differs"}),
        reason=figures["limited_by"],
    )


def figures_table(results: Results) -> pd.DataFrame:
    """Return the table of figures for programs: one row per figure, with every digit."""
    rows = [
        {
            "claim": claim.name,
            "lesson": claim.lesson,
            "source": claim.source,
            "figure": figure.what,
            "published": figure.published,
            "origin": claim.origin,
            "measured": figure.measured,
            "standard_error": figure.error,
            "slack": figure.tolerance,
            "agrees": figure.agrees,
            "resolution": figure.detectable_error,
            "sees_5_percent": figure.is_sensitive,
            "limited_by": figure.limitation,
            "verdict": result.verdict,
            "seconds": round(result.seconds, 2),
        }
        for claim, result in results
        for figure in result.figures or (NOTHING,)
    ]
    return pd.DataFrame(rows)


def count_verdicts(results: Results) -> str:
    """Return the number of claims per verdict, as text, and how many of each are of figures that their source prints or stores."""
    tally = Counter(result.verdict for _, result in results)
    ours = Counter(result.verdict for claim, result in results if claim.origin == "recomputed")
    counts = ", ".join(
        f"{tally[verdict]} {verdict}" + f" ({ours[verdict]} of them with recomputed figures)" * bool(ours[verdict])
        for verdict in (*VERDICTS, FAILED)
        if tally[verdict]
    )
    return f"{counted(len(results), 'claim')}: {counts}"


def markdown(results: Results) -> str:
    """Return the verdicts and figures as Markdown, by lesson."""
    parts = [f"# {TITLE}\n\n{count_verdicts(results)}\n"]
    for lesson, own in groupby(results, lambda item: item[0].lesson):
        parts.append(f"## {lesson}\n\n{LESSONS.get(lesson, '')}\n")
        for claim, result in own:
            parts.append(f"### {claim.name}: {result.verdict}\n\n{claim.statement} ({claim.source})\n")
            if result.figures:
                shown = for_readers(figures_table([(claim, result)]))
                parts.append(plain_markdown(readable(Table(claim.name, shown, FIGURE))) + "\n")
            if result.remark:
                parts.append(f"*{escape_markdown(result.remark)}*\n")
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
    """Yield the lines printed for one claim."""
    origin = ", as stored" if is_stored else ""
    yield f"{claim.name:<4} {result.verdict:<29} {duration(result.seconds):>7}{origin}  {claim.source}: {claim.statement}"
    for figure in result.figures:
        if not figure.agrees:
            yield f"       {figure.what}: published {figure.published}, measured {measured_text(figure.measured, figure.error)}"
    if result.remark:
        yield f"       {result.remark}"


def list_lines(claims: Sequence[type[Claim]]) -> Iterator[str]:
    """Yield the lines of ``--list``."""
    for lesson, own in groupby(claims, lambda claim: claim.lesson):
        yield printable(f"{lesson}: {LESSONS.get(lesson, '')}")
        for claim in own:
            quick = "quick" if claim.quick else "     "
            yield f"  {claim.name:<4} {quick}  {printable(f'{claim.statement} ({claim.source})')}"
