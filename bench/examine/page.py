"""Writes the files of an examination: text, tables, charts, and one self-contained page."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from bench.examine.ci import as_junit, as_markdown
from bench.examine.findings import Findings
from bench.examine.lines import Break
from bench.report.figures import save, styled
from bench.report.style import GREY, MARKERS, PALETTE
from bench.report.text import number
from bench.report.web import shell
from bench.run.files import make_directory, write_all, write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 7.16
"""Width of two columns of a paper in inches."""
SHOWN = 8
"""Most components drawn: those with the largest errors."""
BODY = """<header>
<h1>{title}</h1>
<p class="finding {state}">{verdict}</p>
</header>
<main>
{charts}
{breaks}
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
        for name, (title, figure, data) in charts(report).items():
            saved = save(figure, directory / name, data=data)
            paths += saved
            pictures.append(f"<h2>{escape(title)}</h2>{shell.picture(saved[0], title)}")
    title = f"Examination of {report.name}"
    body = BODY.format(
        title=escape(title),
        state="bad" if report.status else "good",
        verdict="<br>".join(escape(text) for text in (report.conclusion, report.noise_answer, report.advice) if text),
        charts="\n".join(pictures),
        breaks=_breaks(report),
        text=_wrapping(str(report)),
        table=report.frame.to_html(index=False, float_format=lambda x: number(x, 5), border=0),
    )
    write_whole(directory / "report.html", shell.document(title, body).encode())
    return [*paths, directory / "report.html"]


def _breaks(report: Findings) -> str:
    """Return HTML with an entry per jump or kink that opens its picture."""
    entries = []
    for index, line in enumerate(report.lines):
        for one in line.breaks:
            size = "height" if one.kind == "jump" else "change of slope"
            place = ", ".join(
                f"{report.names[i]} = {report.theta[i] + one.at * line.direction[i]:.6g}"
                for i in range(min(report.theta.size, SHOWN))
            )
            title = f"line {index + 1}: {one.kind} at t = {one.at:+.4f}, {size} {number(one.size)}"
            entries.append(
                f"<details><summary>{escape(title)}</summary><p>{escape(place)}</p>{_picture(one, title)}</details>"
            )
    return "<h2>Jumps and kinks</h2>" + "\n".join(entries) if entries else ""


def _picture(one: Break, title: str) -> str:
    """Return the costs beside a break as an SVG picture."""
    points = [(t, f) for t, f in one.near if np.isfinite(f)]
    if len(points) < 2:
        return ""
    t, f = np.array(points).T
    x = 40 + 320 * (t - t.min()) / (np.ptp(t) or 1.0)
    y = 150 - 120 * (f - f.min()) / (np.ptp(f) or 1.0)
    dots = "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="4" fill="{PALETTE[0]}"/>' for a, b in zip(x, y, strict=True))
    middle = 40 + 320 * (one.at - t.min()) / (np.ptp(t) or 1.0)
    return (
        f'<svg viewBox="0 0 400 190" width="400" role="img" aria-label="{escape(title)}">'
        f'<line x1="{middle:.1f}" x2="{middle:.1f}" y1="15" y2="165" stroke="{PALETTE[2]}"/>{dots}'
        f'<text x="40" y="182" font-size="12" fill="currentColor">t = {t.min():.6f}</text>'
        f'<text x="360" y="182" font-size="12" fill="currentColor" text-anchor="end">{t.max():.6f}</text>'
        f'<text x="4" y="14" font-size="12" fill="currentColor">cost, from {f.min():.6g} to {f.max():.6g}</text></svg>'
    )


def _wrapping(text: str) -> str:
    """Return text as HTML in which sentences wrap and aligned columns do not."""
    lines = [(escape(line), "  " in line.strip()) for line in text.splitlines()]
    return "\n".join(line if row else f'<span class="sentence">{line}</span>' for line, row in lines)


def charts(report: Findings) -> dict[str, tuple[str, Figure, pd.DataFrame]]:
    """Return, by name, the title, figure and plotted data of each chart for which the report has data."""
    drawn = {}
    if report.check is not None and report.gradient:
        steps = [
            pd.DataFrame({"derivative": part.name if part.component is None else report.label(part), "step": part.sample.step,
                          "difference": part.sample.differences, "program": part.program})
            for part in report.check.parts
        ]  # fmt: skip
        drawn["steps"] = ("The gradient against differences of the cost", _steps(report), pd.concat(steps))
    if report.lines:
        lines = [pd.DataFrame({"line": i + 1, "t": line.at, "cost": line.costs}) for i, line in enumerate(report.lines)]
        drawn["lines"] = ("The cost on lines through theta", _lines(report), pd.concat(lines))
    if len(report.smoothed) > 1:
        drawn["sigmas"] = ("Errors under noise on theta", _sigmas(report), report.sigmas)
    return drawn


def _figure(panels: int, height: float = 2.6) -> tuple[Figure, list[Axes]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(1, panels, squeeze=False)[0])


def _steps(report: Findings) -> Figure:
    """Return a figure of each derivative's error and each direction's Taylor remainder, against the step."""
    assert report.check is not None
    figure, (left, right) = _figure(2, 2.9)
    components = sorted(report.check.components, key=lambda p: -np.nan_to_num(p.error, nan=np.inf))[:SHOWN]
    for index, part in enumerate(components):
        sample = part.sample
        size = max(abs(part.difference), abs(part.program)) or 1.0
        error = np.abs(sample.differences - part.program) / size
        left.loglog(
            sample.step, np.where(error > 0, error, np.nan), color=PALETTE[index % 8], marker=MARKERS[index % 8],
            markersize=3, label=report.label(part),
        )  # fmt: skip
    left.set_xlabel("step, in units of the input")
    left.set_ylabel("relative error of the gradient")
    left.set_title(
        "Falls with the step squared until rounding where the\ngradient is right; levels off where it is wrong",
        fontsize=8,
    )
    if components:
        left.legend(fontsize=7, loc="best", frameon=True, framealpha=0.8, edgecolor="none")
    whole = [part for part in report.check.parts if part.component is None]
    for index, part in enumerate(whole):
        sample = part.sample
        with np.errstate(all="ignore"):
            rest = np.abs(sample.plus - sample.centre - sample.step * part.program)
        right.loglog(
            sample.step, np.where(rest > 0, rest, np.nan), color=PALETTE[index % 8], marker=MARKERS[index % 8],
            markersize=3, label=part.name,
        )  # fmt: skip
        steps = np.array([sample.step[0], sample.step[-1]])
        for power, style in ((1, ":"), (2, "--")):
            top = rest[0] if rest[0] > 0 else 1.0
            name = f"order {power}: {'right' if power == 2 else 'wrong'}" if index == 0 else None
            right.loglog(
                steps, top * (steps / steps[0]) ** power, color=GREY, linestyle=style, linewidth=0.8, label=name
            )
    floor = np.nanmin(
        [np.nanmin(np.where(p.sample.uncertainty > 0, p.sample.uncertainty, np.nan)) for p in whole] or [1e-16]
    )
    right.set_ylim(bottom=max(1e-3 * floor * 1e-10, 1e-20))
    right.set_xlabel("step h along a random direction d")
    right.set_ylabel("|f(x + h d) − f(x) − h g·d|")
    right.set_title("The Taylor remainder: order 2 for a right gradient,\n1 for a wrong one", fontsize=8)
    right.legend(fontsize=7, loc="upper left")
    return figure


def _lines(report: Findings) -> Figure:
    """Return a figure of the cost along each line, with its jumps and kinks."""
    figure, panels = _figure(len(report.lines))
    for index, (panel, line) in enumerate(zip(panels, report.lines, strict=True)):
        panel.plot(line.at, line.costs, color=PALETTE[0], marker=".", markersize=2.5, linewidth=0.9)
        for kind, colour, style in (("jump", PALETTE[2], "-"), ("kink", PALETTE[3], "--")):
            for count, b in enumerate(b for b in line.breaks if b.kind == kind):
                panel.axvline(b.at, color=colour, linestyle=style, linewidth=0.9, label=kind if count == 0 else None)
        panel.set_xlabel(f"t, in sigma = {number(report.reach)}{' of the scale' if report.relative else ''}")
        panel.set_title(
            f"line {index + 1}: {'no break found' if not line.breaks else f'{len(line.breaks)} breaks found'}"
        )
        if line.breaks:
            panel.legend(fontsize=7)
    panels[0].set_ylabel("cost")
    return figure


def _sigmas(report: Findings) -> Figure:
    """Return a figure of the gradient's bias and the effect of smoothing, against sigma."""
    figure, (panel,) = _figure(1)
    shown = [one for one in report.smoothed if one.known]
    sigma = np.array([one.sigma for one in shown])
    if shown and np.isfinite([one.bias for one in shown]).all():
        bias = np.array([[one.bias, one.bias_low, one.bias_high] for one in shown]) / np.array(
            [[o.norm] for o in shown]
        )
        clear = bias[:, 1] > 0
        panel.vlines(sigma[clear], bias[clear, 1], bias[clear, 2], color=PALETTE[2])
        if clear.any():
            panel.plot(
                sigma[clear], bias[clear, 0], "o", color=PALETTE[2], label="bias of the gradient, with 95% interval"
            )
        panel.plot(
            sigma[~clear],
            bias[~clear, 2],
            "v",
            mfc="none",
            color=PALETTE[2],
            label="not detected: upper end of the interval",
        )
    moved = np.array([one.moved / one.norm for one in shown])
    if np.isfinite(moved).any():
        panel.plot(sigma, moved, "s-", color=PALETTE[0], label="change of the gradient by smoothing")
    panel.axhline(0.1, color=GREY, linewidth=0.8, linestyle=":", label="10%")
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlabel("sigma, noise on theta")
    panel.set_ylabel("relative to |∇J|")
    panel.legend(fontsize=7)
    return figure
