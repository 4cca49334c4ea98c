"""Writes fits as tables and a chart: what a record tells, errors in units of the bound, coverage of intervals."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.experiment.axes import table
from bench.experiment.experiment import Experiment
from bench.report.figures import save, styled
from bench.report.page import WIDTH
from bench.report.style import MARKERS, PALETTE, plain
from bench.report.tables import plain_markdown
from bench.report.text import axis_value, counted, number
from bench.report.views import Arranged, arranged, attempted
from bench.report.web.content import problems
from bench.run.files import write_all

PARTS = ("scene", "contact", "integrator")
NOTES = (
    "tells: the products of powers that a record of the motion depends on. bound: Cramer-Rao bound of the relative standard "
    "deviation. converged: fits whose residuals are the noise. error: root mean square error of converged fits in units of the "
    "bound; 1 is the best there is. coverage: share of their 95% intervals that hold the truth. hidden: fits that claim to tell "
    "more than the record does. single: one rollout. multiple: windows whose ends must meet. windows: windows on their own.",
)


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``identify`` (.csv, .md) and the chart."""
    shown = arranged(experiment, rows)
    lines = flat(shown)
    texts = [f"# {experiment.name}: which parameters does a record tell?", *findings(shown)]
    texts += [plain_markdown(readable(lines)), *NOTES]
    contents = {
        "identify.csv": table(experiment, rows).to_csv(index=False, lineterminator="\n"),
        "identify.md": "\n\n".join(texts) + "\n",
    }
    paths = write_all(experiment.directory, contents)
    if len(lines):
        with styled():
            paths += save(figure(lines), experiment.directory / "identify", experiment.formats)
    return paths


def flat(shown: Arranged) -> pd.DataFrame:
    """Return a line per problem, optimizer, seed and way of fitting."""
    kept = attempted(shown.rows)
    kept = kept[kept["status"] == "ok"]
    names = problems(shown, PARTS, rows=kept)
    names = names + (", " + kept["optimizer"] if kept["optimizer"].nunique() > 1 else "")
    lines = []
    for place, (name, row) in zip(kept.index, zip(names, kept.to_dict("records"), strict=True), strict=True):
        for i, way in enumerate(row["shooting"]):
            own = {
                key: row[key][i]
                for key in (
                    "converged",
                    "converged_low",
                    "converged_high",
                    "error",
                    "coverage",
                    "coverage_low",
                    "coverage_high",
                    "hidden",
                )
            }
            lines.append({
                "row": place, "problem": name, "shooting": way, "tells": ", ".join(row["invariants"]),
                "bound": ", ".join(number(b) for b in row["bound"]), "condition": row["condition"], "fits": int(row["fits"]),
                "step_note": row["step_note"], "words": row["words"], **own,
            })  # fmt: skip
    return pd.DataFrame(lines)


def readable(lines: pd.DataFrame) -> pd.DataFrame:
    """Return the lines as texts."""
    out = []
    for row in lines.to_dict("records"):
        out.append({
            "problem": row["problem"], "tells": row["tells"], "bound": row["bound"], "condition": axis_value(float(f"{row['condition']:.3g}")),
            "shooting": row["shooting"], "converged": _interval(row, "converged"), "error": number(row["error"]),
            "coverage": _interval(row, "coverage"), "hidden": f"{row['hidden']} of {row['fits']}",
        })  # fmt: skip
    return pd.DataFrame(out)


def _interval(row: dict[str, float], name: str) -> str:
    if math.isnan(row[name]):
        return "-"
    return f"{number(row[name])} [{number(row[f'{name}_low'])}, {number(row[f'{name}_high'])}]"


def findings(shown: Arranged) -> list[str]:
    """Say which fits and intervals fail; then for each problem what its record tells, and whether for its step only."""
    lines = flat(shown)
    if not len(lines):
        return ["No fit gave a result: the table has the reason of each."]
    parts = lines.groupby("problem", sort=False).first()
    return [*failing(lines), *(f"{name}: {one['words']}; {one['step_note']}." for name, one in parts.iterrows())]


def _lost(lines: pd.DataFrame) -> pd.DataFrame:
    """Return the cases whose fits do not converge."""
    return lines[lines["converged_high"] < 0.9]


def _short(lines: pd.DataFrame) -> pd.DataFrame:
    """Return the cases whose intervals cover too little."""
    return lines[lines["coverage_high"] < 0.95]


def headline(lines: pd.DataFrame) -> str:
    """Write in how many cases fits fail, and in how many intervals cover too little."""
    fits = (
        f"Fits fail in {len(_lost(lines))} of {counted(len(lines), 'case')}"
        if len(_lost(lines))
        else "All fits converge"
    )
    short = len(_short(lines))
    return f"{fits}; intervals cover {f'too little in {short}' if short else 'the truth as often as they say'}"


def failing(lines: pd.DataFrame) -> list[str]:
    """Say which fits do not converge, which intervals cover too little, and how many hide what the record lacks."""
    said = []
    lost, short = _lost(lines), _short(lines)
    if len(lost):
        where = "; ".join(
            f"{name} ({', '.join(f'{way} {number(share)}' for way, share in zip(part['shooting'], part['converged'], strict=True))})"
            for name, part in lost.groupby("problem", sort=False)
        )
        said.append(
            f"Fits fail in {counted(len(lost), 'case')} of {len(lines)}: their residuals are not the noise, since the model is "
            f"wrong or the fit ended elsewhere. Share of fits that converged: {where}."
        )
    if len(short):
        worst = short.sort_values("coverage").iloc[0]
        said.append(
            f"Intervals cover too little in {counted(len(short), 'case')}; the worst is {worst['problem']} by {worst['shooting']}, "
            f"{number(worst['coverage'])} [{number(worst['coverage_low'])}, {number(worst['coverage_high'])}] instead of 0.95."
        )
    hidden = int(lines["hidden"].sum())
    said.append(f"{hidden} of {int(lines['fits'].sum())} fits hide a direction that the record does not see.")
    return said


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the findings, the table, and reasons of cells without a result."""
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = max(console.width, 180)
    counts = ", ".join(f"{n} {status}" for status, n in rows["status"].value_counts().items())
    console.print(f"\n{experiment.name}: {experiment.question}\n{counted(len(rows), 'cell')}: {counts}")
    shown = arranged(experiment, rows)
    for sentence in findings(shown):
        console.print(sentence)
    texts = readable(flat(shown))
    grid = Table(box=None, padding=(0, 2, 0, 0))
    for name in texts:
        grid.add_column(str(name))
    for line in texts.to_numpy():
        grid.add_row(*map(str, line))
    console.print(grid)
    for reason in rows.loc[rows["reason"] != "", "reason"].unique():
        console.print(reason)
    console.print(*NOTES)


def figure(lines: pd.DataFrame) -> Figure:
    """Draw, problem by problem, convergence, errors in units of the bound and coverage of each way of fitting."""
    names = list(dict.fromkeys(lines["problem"]))
    ways = list(dict.fromkeys(lines["shooting"]))
    drawn = Figure(figsize=(WIDTH, 0.42 * len(names) + 1.5), layout="constrained")
    FigureCanvasAgg(drawn)
    drawn.suptitle(headline(lines), fontsize=9, fontweight="bold")
    panels = drawn.subplots(1, 3, sharey=True)
    titles = (
        ("converged", "share of fits that converge"),
        ("error", "error / Cramer-Rao bound"),
        ("coverage", "coverage of 95% intervals"),
    )
    for panel, (column, title) in zip(panels, titles, strict=True):
        for k, way in enumerate(ways):
            part = lines[lines["shooting"] == way].groupby("problem", sort=False).first()
            part = part[np.isfinite(part[column].astype(float))]
            place = np.array([names.index(name) for name in part.index]) + 0.18 * (k - (len(ways) - 1) / 2)
            style = {"color": PALETTE[k], "marker": MARKERS[k], "linestyle": "none"}
            value = part[column].to_numpy(float)
            if column != "error":
                ends = np.abs(np.stack([value - part[f"{column}_low"], part[f"{column}_high"] - value]).astype(float))
                panel.errorbar(value, place, xerr=ends, elinewidth=0.8, label=way, **style)
            else:
                panel.plot(value, place, label=way, **style)
        panel.axvline(
            {"converged": 1.0, "error": 1.0, "coverage": 0.95}[column],
            color="#808080",
            linewidth=0.7,
            linestyle=(0, (3, 2)),
            zorder=0,
        )
        if column == "error":
            panel.set_xscale("log")
        panel.set_xlabel(title)
    panels[0].set_yticks(range(len(names)), [plain(name).replace(", ", "\n", 1) for name in names])
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    handles = [
        Line2D([], [], label=way, color=PALETTE[k], marker=MARKERS[k], linestyle="none") for k, way in enumerate(ways)
    ]
    drawn.legend(handles=handles, loc="outside lower center", ncols=len(ways))
    return drawn
