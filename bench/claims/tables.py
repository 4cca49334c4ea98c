"""Writes what was found: a chart for each claim, the page, and tables in Markdown, CSV and LaTeX."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from textwrap import fill

import pandas as pd

from bench.claims.claim import VERDICTS, Claim, Figure
from bench.claims.discovery import LESSONS
from bench.claims.results import FAILED, ClaimResult
from bench.report.tables import csv, escape_latex, escape_markdown
from bench.report.text import counted, duration, number
from bench.run.files import write_all

Found = Sequence[tuple[type[Claim], ClaimResult]]
WIDE = 26
"""Letters of the longest label with which two fit beside each other below a chart."""
BOLD_LETTERS, LETTERS = 48, 54
"""Letters of a line above a chart 3.5 inches wide, bold and small."""
CSS = """body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse;font-size:14px;margin:.6rem 0}td,th{padding:.15rem .8rem .15rem 0;text-align:left}
td.n{text-align:right;font-variant-numeric:tabular-nums}th{border-bottom:1px solid #888}img{max-width:100%}
.reproduced{color:#00664a}.reserved{color:#8a5a00}.bad{color:#b00020}code{background:#f2f2f2;padding:0 .2rem}
section{margin-top:2.2rem}h3{margin:1.8rem 0 .2rem}p{margin:.3rem 0}.bad b{color:#b00020}"""


def write(directory: Path, found: Found) -> list[Path]:
    """Write charts, tables and page of all results; returns their paths."""
    charts = {claim.name: path for claim, result in found for path in chart(directory, claim, result)}
    paths = write_all(
        directory,
        {
            "claims.md": markdown(found),
            "claims.csv": csv(figures_table(found)),
            "claims.tex": latex(found),
            "claims.html": page(found, charts),
        },
    )
    return [*charts.values(), *paths]


def chart(directory: Path, claim: type[Claim], result: ClaimResult) -> list[Path]:
    """Draw one claim from its stored series; returns the picture's path, or nothing without a series."""
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
        # on short logarithmic axes the labels between powers of ten would overlap
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_scale() == "log":
                axis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(claim.labels[0])
        axes.set_ylabel(claim.labels[1])
        picture.suptitle(fill(claim.learned, BOLD_LETTERS), x=0.02, ha="left", fontsize=8.5, fontweight="bold")
        origin = f"{claim.name}, {claim.source.partition(';')[0]}: {result.verdict}"
        axes.set_title(fill(origin, LETTERS), loc="left", fontsize=7, color=GREY)
        labels = axes.get_legend_handles_labels()[1]
        if labels:
            columns = 2 if max(map(len, labels)) <= WIDE else 1
            picture.legend(loc="outside lower center", ncols=columns, fontsize=7, frameon=False)
        return save(picture, directory / claim.name)[:1]


def measured_text(figure: Figure) -> str:
    """Write the measured number, with its 95% interval where it has a standard error that shows."""
    value = number(figure.measured, 5)
    half = 1.96 * figure.error
    return f"{value} +- {number(half)}" if half > 1e-6 * abs(figure.measured) else value


def resolution_text(figure: Figure) -> str:
    """Write from which change on the figure would have failed."""
    if figure.value == 0.0:
        return "any"
    if figure.resolution < 1e-3:
        return "<0.1%"
    return f"{figure.resolution:.1%}" if figure.resolution < 1 else f"factor {1 + figure.resolution:.1f}"


def sight(figure: Figure) -> str:
    """Write whether the figure sees an error of 5%, and what keeps it from that."""
    return f"no: {figure.limit}" if figure.limit else "yes"


def blind(figures: Sequence[Figure]) -> str:
    """Write how many figures cannot see an error of 5%, and why; empty where all do."""
    limits = [figure.limit for figure in figures if figure.limit]
    if not limits:
        return ""
    reasons = ", ".join(f"{limits.count(limit)} for {limit}" for limit in dict.fromkeys(limits))
    return f"{len(limits)} of {counted(len(figures), 'figure')} cannot see an error of 5%: {reasons}"


def figures_table(found: Found) -> pd.DataFrame:
    """Return one row per figure, with every digit."""
    rows = [
        {
            "claim": claim.name, "lesson": claim.lesson, "source": claim.source, "figure": figure.what,
            "published": figure.published, "measured": figure.measured, "standard_error": figure.error,
            "slack": figure.slack, "agrees": figure.agrees, "resolution": figure.resolution,
            "sees_5_percent": figure.sees, "limited_by": figure.limit,
            "verdict": result.verdict, "seconds": round(result.seconds, 2),
        }
        for claim, result in found
        for figure in result.figures
    ]  # fmt: skip
    return pd.DataFrame(rows)


def lessons(found: Found) -> Iterator[tuple[str, str, Found]]:
    """Yield the lessons in order, each with its sentence and its claims."""
    names = dict.fromkeys([*LESSONS, *(claim.lesson for claim, _ in found)])
    for lesson in names:
        own = [(claim, result) for claim, result in found if claim.lesson == lesson]
        if own:
            yield lesson, LESSONS.get(lesson, ""), own


def counts(found: Found) -> str:
    """Return how many claims got which verdict."""
    tally = [(verdict, sum(result.verdict == verdict for _, result in found)) for verdict in (*VERDICTS, FAILED)]
    return ", ".join(f"{count} {verdict}" for verdict, count in tally if count)


def markdown(found: Found) -> str:
    """Write the verdicts and figures in Markdown, by lesson."""
    parts = [f"# Published claims, run again\n\n{counted(len(found), 'claim')}: {counts(found)}.\n"]
    for lesson, sentence, own in lessons(found):
        parts.append(f"## {lesson}\n\n{sentence}\n")
        for claim, result in own:
            parts.append(f"### {claim.name}: {result.verdict}\n\n{claim.statement} ({claim.source})\n")
            if result.figures:
                lines = [
                    "| figure | published | measured | agrees | would fail at | sees 5% |",
                    "|---|---|---|---|---|---|",
                ]
                lines += [
                    f"| {escape_markdown(f.what)} | {f.published} | {measured_text(f)} | {'yes' if f.agrees else '**no**'} "
                    f"| {resolution_text(f)} | {sight(f)} |"
                    for f in result.figures
                ]
                parts.append("\n".join(lines) + "\n")
            if result.remark:
                parts.append(f"*{escape_markdown(result.remark)}*\n")
            if said := blind(result.figures):
                parts.append(f"{said}.\n")
            parts.append(
                f"Learned: {claim.learned} `python -m bench claims {claim.name}`, {duration(result.seconds)}.\n"
            )
    return "\n".join(parts)


def latex(found: Found) -> str:
    """Write one line per claim, across both columns of a paper: its most sharply resolved figure, and the verdict."""
    lines = [
        r"\begin{table*}\centering\footnotesize\setlength{\tabcolsep}{3pt}",
        r"\begin{tabular}{@{}lp{3.7cm}p{5cm}rrp{2.7cm}@{}}",
        r"\toprule",
        r"claim & source & figure & published & measured & verdict \\",
        r"\midrule",
    ]
    for claim, result in found:
        shown = [f for f in result.figures if f.value] or list(result.figures)
        figure = min(shown, key=lambda f: (f.agrees, f.resolution), default=None)
        cells = [claim.name, claim.source]
        cells += [figure.what, figure.published, number(figure.measured, 4)] if figure else ["", "", ""]
        lines.append(" & ".join(map(escape_latex, [*cells, result.verdict])) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table*}", ""])


def page(found: Found, charts: dict[str, Path]) -> str:
    """Write the page: lessons, claims, figures, charts, in one file with the pictures inside."""
    import base64

    body = [f"<h1>Published claims, run again</h1><p>{counted(len(found), 'claim')}: {escape(counts(found))}.</p>"]
    for lesson, sentence, own in lessons(found):
        body.append(f"<section><h2>{escape(lesson)}</h2><p>{escape(sentence)}</p>")
        for claim, result in own:
            look = {VERDICTS[0]: "reproduced", VERDICTS[1]: "reserved"}.get(result.verdict, "bad")
            body.append(
                f'<h3 id="{escape(claim.name)}">{escape(claim.name)}: <span class="{look}">{escape(result.verdict)}</span></h3>'
                f"<p>{escape(claim.statement)} <i>{escape(claim.source)}</i></p>"
            )
            if result.figures:
                rows = "".join(_row(figure) for figure in result.figures)
                body.append(
                    "<table><tr><th>figure</th><th>published</th><th>measured (95%)</th><th>agrees</th>"
                    f"<th>would fail at</th><th>sees 5%</th></tr>{rows}</table>"
                )
            if result.remark:
                body.append(f"<p><b>Reservation:</b> {escape(result.remark)}</p>")
            if said := blind(result.figures):
                body.append(f"<p>{escape(said)}.</p>")
            if claim.name in charts:
                picture = base64.b64encode(charts[claim.name].read_bytes()).decode()
                body.append(f'<img alt="{escape(claim.statement)}" src="data:image/png;base64,{picture}" width="525">')
            body.append(
                f"<p>{escape(claim.learned)}</p><p><code>python -m bench claims {escape(claim.name)}</code> "
                f"({duration(result.seconds)})</p>"
            )
        body.append("</section>")
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Published claims, run again</title>'
        f"<style>{CSS}</style><body>{''.join(body)}</body></html>\n"
    )


def _row(figure: Figure) -> str:
    cells = [
        figure.what,
        figure.published,
        measured_text(figure),
        "yes" if figure.agrees else "no",
        resolution_text(figure),
        sight(figure),
    ]
    kinds = ("", "n", "n", "", "n", "")
    line = "".join(f'<td class="{kind}">{escape(cell)}</td>' for kind, cell in zip(kinds, cells, strict=True))
    return f'<tr class="{"" if figure.agrees else "bad"}">{line}</tr>'


def lines(claim: type[Claim], result: ClaimResult, again: bool) -> Iterator[str]:
    """Yield what the terminal shows of one claim."""
    worst = [figure for figure in result.figures if not figure.agrees]
    kept = "" if again else ", as stored"
    yield f"{claim.name:<4} {result.verdict:<29} {duration(result.seconds):>7}{kept}  {claim.statement}"
    for figure in worst:
        yield f"       {figure.what}: published {figure.published}, measured {measured_text(figure)}"
    if result.remark:
        yield f"       {result.remark}"
    if said := blind(result.figures):
        yield f"       {said}"


def listed(claims: Sequence[type[Claim]]) -> Iterator[str]:
    """Yield the lines of ``--list``."""
    for lesson in dict.fromkeys(claim.lesson for claim in claims):
        yield f"{lesson}: {LESSONS.get(lesson, '')}"
        for claim in claims:
            if claim.lesson == lesson:
                yield f"  {claim.name:<4} {'quick' if claim.quick else '     '}  {claim.statement} ({claim.source})"
