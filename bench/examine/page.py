"""Writes the files of an examination: text, tables, charts, and one self-contained page."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np
import pandas as pd

from bench.examine.ci import as_junit, as_markdown
from bench.examine.findings import Findings
from bench.examine.smoothing import TARGET_ERROR
from bench.examine.text import advice, conclusion, noise_answer
from bench.experiment.columns import Column
from bench.experiment.views import Chart, Mark
from bench.report.draw import draw
from bench.report.figures import save, styled
from bench.report.text import number
from bench.report.web import shell
from bench.run.files import make_directory, write_all, write_whole

SHOWN = 8
"""Most components drawn: those with the largest errors."""
BODY = """<header>
<h1>{title}</h1>
<p class="finding {state}">{verdict}</p>
</header>
<main>
{charts}
<h2>All numbers</h2>
<pre class="lines" tabindex="0">{text}</pre>
<h2>Every derivative checked</h2>
<div class="scroll" tabindex="0">{table}</div>
</main>"""


def write(report: Findings, directory: Path) -> list[Path]:
    """Write the text, the tables, the charts and ``report.html`` into ``directory``, and return their paths.

    The files are ``report.txt``, ``summary.md``, ``junit.xml``, ``derivatives.csv``, ``sigmas.csv``, ``breaks.csv``, the
    charts and ``report.html``, and ``printed.txt`` where the cost prints.
    """
    make_directory(directory)
    tables = {"derivatives": report.frame, "sigmas": report.sigmas, "breaks": report.breaks}
    texts = {f"{name}.csv": table.to_csv(index=False, lineterminator="\n") for name, table in tables.items()}
    texts |= {"summary.md": as_markdown([report]), "junit.xml": as_junit([report])}
    if report.printed.count:
        texts["printed.txt"] = "".join(f"{line}\n" for line in report.printed.lines)
    paths = write_all(directory, {"report.txt": f"{report}\n", **texts})
    pictures = []
    with styled():
        for chart in charts(report):
            figure = draw(chart)
            paths += save(figure, directory / chart.name, data=chart.plotted())
            pictures.append(f"<h2>{escape(chart.title)}</h2>{shell.drawing(figure, chart.name, chart.title)}")
    title = f"Examination of {report.name}"
    body = BODY.format(
        title=escape(title),
        state="bad" if report.status else "good",
        verdict="<br>".join(
            escape(text) for text in (conclusion(report), noise_answer(report), advice(report)) if text
        ),
        charts="\n".join(pictures),
        text=_wrapping(str(report)),
        table=report.frame.to_html(index=False, float_format=lambda x: number(x, 5), border=0),
    )
    write_whole(directory / "report.html", shell.document(title, body).encode())
    return [*paths, directory / "report.html"]


def _wrapping(text: str) -> str:
    """Return text as HTML in which sentences wrap and aligned columns do not."""
    lines = [(escape(line), "  " in line.strip()) for line in text.splitlines()]
    return "\n".join(line if row else f'<span class="sentence">{line}</span>' for line, row in lines)


def charts(report: Findings) -> list[Chart]:
    """Return the charts for which the report has data: steps, lines and sigmas."""
    found = []
    if report.check is not None and report.gradient:
        parts = sorted(report.check.parts, key=lambda part: -np.nan_to_num(part.error, nan=np.inf))[:SHOWN]
        steps = pd.concat([
            pd.DataFrame({"derivative": report.label(part), "step": part.sample.step / part.sample.scale,
                          "error": part.sample.errors})
            for part in parts
        ])  # fmt: skip
        found.append(Chart(
            "steps", steps, [Column("step", label="step, in units of the input's scale", log=True)],
            [Column("error", label="relative error of the gradient", log=True)], series="derivative",
            title="The gradient against differences of the cost",
            text="Falls with the step squared until rounding where the gradient is right; levels off where it is wrong.",
        ))  # fmt: skip
    if report.lines:
        lines = pd.concat([
            pd.DataFrame({"line": f"line {i + 1}", "t": line.at, "cost": line.costs}) for i, line in enumerate(report.lines)
        ])  # fmt: skip
        marks = [
            Mark(f"{b.kind}", b.at, panel=f"line {i + 1}") for i, line in enumerate(report.lines) for b in line.breaks
        ]
        found.append(Chart("lines", lines, [Column("t", label="t, in sigma")], [Column("cost")], panel="line", marks=marks,
                           title="The cost on lines through theta"))  # fmt: skip
    if len(known := [one for one in report.smoothed if one.known]) > 1:
        sigmas = pd.DataFrame([
            {"sigma": one.sigma, "bias": one.bias / one.norm, "bias_low": one.bias_low / one.norm,
             "bias_high": one.bias_high / one.norm} for one in known
        ])  # fmt: skip
        bias = Column(
            "bias", label="bias of the gradient, relative to |grad J|", low="bias_low", high="bias_high", log=True
        )
        found.append(Chart("sigmas", sigmas, [Column("sigma", label="sigma, noise on theta", log=True)], [bias],
                           marks=[Mark("10%", TARGET_ERROR, axis="y")], title="Bias under noise on theta"))  # fmt: skip
    return found
