"""Writes the results of claims: a chart per claim, and tables in Markdown, CSV and LaTeX."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import fill

import pandas as pd

from bench.claims.claim import VERDICTS, Claim, Figure
from bench.claims.discovery import LESSONS
from bench.claims.results import FAILED, ClaimResult
from bench.report.tables import escape_latex, escape_markdown, plain_markdown
from bench.report.text import counted, duration, number

Results = Sequence[tuple[type[Claim], ClaimResult]]
WIDE = 26
"""Length of the longest label [characters] for which a legend below a chart has two columns."""
BOLD_WIDTH, SMALL_WIDTH = 48, 54
"""Characters of a bold and of a small line above a chart 3.5 inches wide."""


def chart(directory: Path, claim: type[Claim], result: ClaimResult) -> list[Path]:
    """Draw one claim from its stored series. Returns the path of the chart, or an empty list without a series."""
    if not result.series:
        return []
    from cycler import cycler
    from matplotlib import rcParams
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Picture
    from matplotlib.ticker import NullFormatter

    from bench.report.figures import save, styled
    from bench.report.style import GREY, PALETTE

    with styled():
        rcParams["axes.prop_cycle"] = cycler(color=[PALETTE[i] for i in (2, 0, 3, 4)])
        picture = Picture(figsize=(3.5, 3.3), layout="constrained")
        FigureCanvasAgg(picture)
        axes = picture.add_subplot()
        claim().draw(axes, result.series)
        # on short logarithmic axes, labels between powers of ten would overlap
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_scale() == "log":
                axis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(claim.labels[0])
        axes.set_ylabel(claim.labels[1])
        picture.suptitle(fill(claim.learned, BOLD_WIDTH), x=0.02, ha="left", fontsize=8.5, fontweight="bold")
        origin = f"{claim.name}, {claim.source.partition(';')[0]}: {result.verdict}"
        axes.set_title(fill(origin, SMALL_WIDTH), loc="left", fontsize=7, color=GREY)
        labels = axes.get_legend_handles_labels()[1]
        if labels:
            columns = 2 if max(map(len, labels)) <= WIDE else 1
            picture.legend(loc="outside lower center", ncols=columns, fontsize=7, frameon=False)
        series = {name: pd.Series(values) for name, values in result.series.items()}
        return save(picture, directory / claim.name, data=pd.DataFrame(series))[:1]


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
    limits = [figure.limitation for figure in figures if figure.limitation]
    if not limits:
        return ""
    reasons = ", ".join(f"{limits.count(limit)} for {limit}" for limit in dict.fromkeys(limits))
    return f"{len(limits)} of {counted(len(figures), 'figure')} cannot detect an error of 5%: {reasons}"


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
        for figure in result.figures
    ]  # fmt: skip
    return pd.DataFrame(rows)


def by_lesson(results: Results) -> Iterator[tuple[str, str, Results]]:
    """Yield each lesson, in order, with its summary and its claims."""
    names = dict.fromkeys([*LESSONS, *(claim.lesson for claim, _ in results)])
    for lesson in names:
        own = [(claim, result) for claim, result in results if claim.lesson == lesson]
        if own:
            yield lesson, LESSONS.get(lesson, ""), own


def count_verdicts(results: Results) -> str:
    """Return the number of claims per verdict, as text."""
    tally = [(verdict, sum(result.verdict == verdict for _, result in results)) for verdict in (*VERDICTS, FAILED)]
    return ", ".join(f"{count} {verdict}" for verdict, count in tally if count)


def markdown(results: Results) -> str:
    """Return the verdicts and figures as Markdown, by lesson."""
    parts = [f"# Published claims, run again\n\n{counted(len(results), 'claim')}: {count_verdicts(results)}.\n"]
    for lesson, summary, own in by_lesson(results):
        parts.append(f"## {lesson}\n\n{summary}\n")
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


def latex(results: Results) -> str:
    """Return a LaTeX table across both columns of a paper: per claim the verdict and one figure.

    The figure is the most sensitive figure that disagrees or, if all figures agree, the most sensitive figure.
    """
    lines = [
        r"\begin{table*}\centering\footnotesize\setlength{\tabcolsep}{3pt}",
        r"\begin{tabular}{@{}lp{3.7cm}p{5cm}rrp{2.7cm}@{}}",
        r"\toprule",
        r"claim & source & figure & published & measured & verdict \\",
        r"\midrule",
    ]
    for claim, result in results:
        shown = [f for f in result.figures if f.value] or list(result.figures)
        figure = min(shown, key=lambda f: (f.agrees, f.detectable_error), default=None)
        cells = [claim.name, claim.source]
        cells += [figure.what, figure.published, number(figure.measured, 4)] if figure else ["", "", ""]
        lines.append(" & ".join(map(escape_latex, [*cells, result.verdict])) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table*}", ""])


def result_lines(claim: type[Claim], result: ClaimResult, is_stored: bool) -> Iterator[str]:
    """Yield the lines printed for one claim."""
    origin = ", as stored" if is_stored else ""
    yield f"{claim.name:<4} {result.verdict:<29} {duration(result.seconds):>7}{origin}  {claim.statement}"
    for figure in result.figures:
        if not figure.agrees:
            yield f"       {figure.what}: published {figure.published}, measured {measured_text(figure)}"
    for sentence in filter(None, (result.remark, insensitive_text(result.figures))):
        yield f"       {sentence}"


def list_lines(claims: Sequence[type[Claim]]) -> Iterator[str]:
    """Yield the lines of ``--list``."""
    for lesson in dict.fromkeys(claim.lesson for claim in claims):
        yield f"{lesson}: {LESSONS.get(lesson, '')}"
        for claim in claims:
            if claim.lesson == lesson:
                yield f"  {claim.name:<4} {'quick' if claim.quick else '     '}  {claim.statement} ({claim.source})"
