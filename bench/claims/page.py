"""Writes the files of all claims, and the page among them: contents, a filter by verdict, and every claim's figures."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path

from bench.claims import tables
from bench.claims.claim import REPRODUCED, RESERVED, VERDICTS, Claim
from bench.claims.results import FAILED, ClaimResult
from bench.claims.tables import Results
from bench.report.draw import draw
from bench.report.figures import save, styled
from bench.report.tables import csv
from bench.report.text import counted, duration
from bench.report.web import shell
from bench.report.writer import ANSWER
from bench.run.files import write_all

TITLE = "Published claims, run again"
QUESTION = "Which published results on gradients through simulators are reproduced?"
NUMBERS = ("published", "measured (95%)", "would fail at")
"""Columns of the figures that are aligned to the right."""
LOOKS = {REPRODUCED: "good", RESERVED: "reserved"}
"""Class of the text of a verdict; all other verdicts have the class ``bad``."""


def write(directory: Path, results: Results) -> list[Path]:
    """Write charts, tables and the page of all results. Returns the paths of tables and page."""
    drawings = {}
    with styled():
        for chart in filter(None, (tables.chart(claim, result) for claim, result in results)):
            figure = draw(chart)
            save(figure, directory / chart.name, data=chart.plotted())
            drawings[chart.name] = shell.drawing(figure, chart.name, chart.title)
    return write_all(
        directory,
        {
            "claims.md": tables.markdown(results),
            "claims.csv": csv(tables.figures_table(results)),
            "claims.tex": tables.latex(results),
            "claims.html": page(results, drawings),
            ANSWER: json.dumps(
                {
                    "experiment": "claims",
                    "question": QUESTION,
                    "answer": f"{counted(len(results), 'published claim')}: {tables.count_verdicts(results)}.",
                    "chart": next(iter(drawings), ""),
                },
                indent=1,
            )
            + "\n",
        },
    )


def page(results: Results, drawings: Mapping[str, str]) -> str:
    """Return the HTML page with contents, lessons, claims, figures and the claims' drawings as HTML."""
    body = (
        f"<header><h1>{TITLE}</h1>"
        f"<p>{counted(len(results), 'claim')}: {escape(tables.count_verdicts(results))}.</p></header>\n"
        f"{_contents(results)}\n<main>\n{''.join(_sections(results, drawings))}</main>"
    )
    return shell.document(TITLE, body, [shell.script("filter.js")])


def _contents(results: Results) -> str:
    """Return the filter by verdict, and a list of links to all claims by lesson."""
    verdicts = [verdict for verdict in (*VERDICTS, FAILED) if any(r.verdict == verdict for _, r in results)]
    numbers = [("", "all", len(results))]
    numbers += [(verdict, verdict, sum(r.verdict == verdict for _, r in results)) for verdict in verdicts]
    choices = "".join(
        f'<label><input type="radio" name="verdict" value="{escape(value)}"{"" if value else " checked"}>'
        f" {escape(label)} <small>{count}</small></label>"
        for value, label, count in numbers
    )
    lessons = "".join(
        f"<li>{escape(lesson)}<ul>{''.join(_link(claim, result) for claim, result in own)}</ul></li>"
        for lesson, _, own in tables.by_lesson(results)
    )
    return (
        f'<nav aria-label="Contents"><fieldset class="choices" data-filter hidden><legend>Show</legend>{choices}'
        f'</fieldset><details open><summary>Contents</summary><ul class="contents">{lessons}</ul></details></nav>'
    )


def _link(claim: type[Claim], result: ClaimResult) -> str:
    return (
        f'<li data-group="{escape(result.verdict)}"><a href="#{escape(claim.name)}">{escape(claim.name)}</a> '
        f"{escape(claim.learned)} {_verdict(result)}</li>"
    )


def _verdict(result: ClaimResult) -> str:
    return f'<span class="{LOOKS.get(result.verdict, "bad")}">{escape(result.verdict)}</span>'


def _sections(results: Results, drawings: Mapping[str, str]) -> Iterator[str]:
    """Yield the HTML of each lesson with its claims."""
    for lesson, summary, own in tables.by_lesson(results):
        articles = "".join(_article(claim, result, drawings.get(claim.name, "")) for claim, result in own)
        yield f"<section><h2>{escape(lesson)}</h2><p>{escape(summary)}</p>{articles}</section>\n"


def _article(claim: type[Claim], result: ClaimResult, drawing: str) -> str:
    """Return the HTML of one claim: what it states, the verdict with its figures, and the command that repeats it."""
    name = escape(claim.name)
    parts = [
        f"<h3>{name}: {_verdict(result)}</h3>",
        drawing,
        f"<p>{escape(claim.statement)} <cite>{escape(claim.source)}</cite></p>",
        f"<p><b>Learned:</b> {escape(claim.learned)}</p>",
    ]
    if result.remark:
        parts.append(f"<p><b>Reservation:</b> {escape(result.remark)}</p>")
    if result.figures:
        parts.append(shell.table(tables.readable_figures(result.figures), NUMBERS, {"NO": "bad"}))
    if sentence := tables.insensitive_text(result.figures):
        parts.append(f"<p>{escape(sentence)}.</p>")
    parts.append(f"<p><code>python -m bench claims {name}</code> ({duration(result.seconds)})</p>")
    return f'<article id="{name}" data-group="{escape(result.verdict)}">{"".join(parts)}</article>'
