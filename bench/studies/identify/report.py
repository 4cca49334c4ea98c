"""Writes the table and the chart of fits: identifiable parameters, errors in units of the bound, and coverage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.experiment.experiment import Experiment
from bench.report.figures import save, styled
from bench.report.page import WIDTH
from bench.report.problems import problem_names
from bench.report.study_tables import (
    interval,
    open_console,
    print_reasons,
    print_table,
    titled_figure,
    write_tables,
)
from bench.report.style import MARKERS, PALETTE, plain
from bench.report.tables import plain_markdown
from bench.report.text import axis_value, counted, number
from bench.report.views import Arranged, arrange, attempted

PARTS = ("scene", "contact", "integrator")
STATISTICS = (
    "converged", "converged_low", "converged_high", "error", "coverage", "coverage_low", "coverage_high", "hidden",
)  # fmt: skip
"""Columns with one value per shooting method."""
NOTES = (
    "identifiable: the products of powers of the parameters that a record determines. bound: Cramer-Rao bound of their "
    "relative standard deviations. converged: fits whose residuals are consistent with the noise. error: root mean square "
    "error of converged fits in units of the bound, at best 1. coverage: share of their 95% intervals that contain the "
    "truth. hidden: fits with more identifiable directions than the record has. single: one rollout. multiple: windows "
    "whose ends must meet. windows: independent windows.",
)


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``identify`` (.csv, .md) and the chart."""
    shown = arrange(experiment, rows)
    lines = flatten(shown)
    texts = [f"# {experiment.name}: which parameters are identifiable from a record?", *findings(shown)]
    paths = write_tables(experiment, rows, "identify", [*texts, plain_markdown(readable(lines)), *NOTES])
    if len(lines):
        with styled():
            paths += save(figure(lines), experiment.directory / "identify", experiment.formats)
    return paths


def flatten(shown: Arranged) -> pd.DataFrame:
    """Return one line per problem, optimizer, seed and shooting method."""
    rows = attempted(shown.rows)
    rows = rows[rows["status"] == "ok"]
    names = problem_names(shown, PARTS, rows=rows)
    names = names + (", " + rows["optimizer"] if rows["optimizer"].nunique() > 1 else "")
    lines = []
    for index, name, row in zip(rows.index, names, rows.to_dict("records"), strict=True):
        for i, shooting in enumerate(row["shooting"]):
            lines.append({
                "row": index, "problem": name, "shooting": shooting, "identifiable": ", ".join(row["invariants"]),
                "bound": ", ".join(number(b) for b in row["bound"]), "condition": row["condition"], "fits": int(row["fits"]),
                "step_note": row["step_note"], "words": row["words"], **{column: row[column][i] for column in STATISTICS},
            })  # fmt: skip
    return pd.DataFrame(lines)


def readable(lines: pd.DataFrame) -> pd.DataFrame:
    """Return the lines of :func:`flatten` formatted as strings."""
    out = []
    for row in lines.to_dict("records"):
        out.append({
            "problem": row["problem"], "identifiable": row["identifiable"], "bound": row["bound"], "condition": axis_value(float(f"{row['condition']:.3g}")),
            "shooting": row["shooting"], "converged": interval(row, "converged"), "error": number(row["error"]),
            "coverage": interval(row, "coverage"), "hidden": f"{row['hidden']} of {row['fits']}",
        })  # fmt: skip
    return pd.DataFrame(out)


def findings(shown: Arranged) -> list[str]:
    """Return the findings: failures, then each problem's identifiable parameters and dependence on the time step."""
    lines = flatten(shown)
    if not len(lines):
        return ["No fit gave a result: the table has the reason of each."]
    parts = lines.groupby("problem", sort=False).first()
    return [*failures(lines), *(f"{name}: {row['words']}; {row['step_note']}." for name, row in parts.iterrows())]


def _unconverged(lines: pd.DataFrame) -> pd.DataFrame:
    """Return the lines where fewer than 90% of the fits converge, with 95% confidence."""
    return lines[lines["converged_high"] < 0.9]


def _undercovered(lines: pd.DataFrame) -> pd.DataFrame:
    """Return the lines whose intervals contain the truth less often than stated, with 95% confidence."""
    return lines[lines["coverage_high"] < 0.95]


def headline(lines: pd.DataFrame) -> str:
    """Format the title of the chart: in how many cases fits do not converge, and in how many intervals are too narrow."""
    n_unconverged, n_narrow = len(_unconverged(lines)), len(_undercovered(lines))
    cases = counted(len(lines), "case")
    fits = f"Fits do not converge in {n_unconverged} of {cases}" if n_unconverged else f"Fits converge in all {cases}"
    return f"{fits}; 95% intervals are " + (f"too narrow in {n_narrow}" if n_narrow else "never too narrow")


def failures(lines: pd.DataFrame) -> list[str]:
    """Return the failures as sentences: poor convergence, narrow intervals, fits with too many identifiable directions."""
    sentences = []
    unconverged, narrow = _unconverged(lines), _undercovered(lines)
    if len(unconverged):
        shares = "; ".join(
            f"{name} ({', '.join(f'{shooting} {number(share)}' for shooting, share in zip(part['shooting'], part['converged'], strict=True))})"
            for name, part in unconverged.groupby("problem", sort=False)
        )
        sentences.append(
            f"Fits do not explain the record in {len(unconverged)} of {counted(len(lines), 'case')}: residuals exceed the "
            f"stated noise. Either the model is wrong or the optimiser stopped early. Share of fits that converged: {shares}."
        )
    if len(narrow):
        worst = narrow.sort_values("coverage").iloc[0]
        sentences.append(
            f"95% intervals are too narrow in {counted(len(narrow), 'case')}. Worst coverage: {interval(worst, 'coverage')}, "
            f"{worst['problem']} by {worst['shooting']} shooting."
        )
    hidden = int(lines["hidden"].sum())
    sentences.append(
        f"{hidden} of {int(lines['fits'].sum())} fits have more identifiable directions than the record has."
    )
    return sentences


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the findings, the table, and the reasons of cells without a result."""
    console = open_console(experiment, rows)
    shown = arrange(experiment, rows)
    console.print(*findings(shown), sep="\n")
    print_table(console, readable(flatten(shown)))
    print_reasons(console, rows)
    console.print(*NOTES)


def figure(lines: pd.DataFrame) -> Figure:
    """Draw convergence, error in units of the bound, and coverage of each shooting method, a row per problem."""
    names = list(dict.fromkeys(lines["problem"]))
    methods = list(dict.fromkeys(lines["shooting"]))
    drawn = titled_figure(WIDTH, 0.42 * len(names) + 1.5, headline(lines))
    panels = drawn.subplots(1, 3, sharey=True)
    quantities = (
        ("converged", "share of fits that converge", 1.0),
        ("error", "error / Cramer-Rao bound", 1.0),
        ("coverage", "coverage of 95% intervals", 0.95),
    )
    for panel, (column, title, ideal) in zip(panels, quantities, strict=True):
        for k, shooting in enumerate(methods):
            part = lines[lines["shooting"] == shooting].groupby("problem", sort=False).first()
            part = part[np.isfinite(part[column].astype(float))]
            place = np.array([names.index(name) for name in part.index]) + 0.18 * (k - (len(methods) - 1) / 2)
            style = {"color": PALETTE[k], "marker": MARKERS[k], "linestyle": "none"}
            value = part[column].to_numpy(float)
            if column != "error":
                ends = np.abs(np.stack([value - part[f"{column}_low"], part[f"{column}_high"] - value]).astype(float))
                panel.errorbar(value, place, xerr=ends, elinewidth=0.8, label=shooting, **style)
            else:
                panel.plot(value, place, label=shooting, **style)
        panel.axvline(ideal, color="#808080", linewidth=0.7, linestyle=(0, (3, 2)), zorder=0)
        if column == "error":
            panel.set_xscale("log")
        panel.set_xlabel(title)
    panels[0].set_yticks(range(len(names)), [plain(name).replace(", ", "\n", 1) for name in names])
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    handles = [
        Line2D([], [], label=name, color=PALETTE[k], marker=MARKERS[k], linestyle="none")
        for k, name in enumerate(methods)
    ]
    drawn.legend(handles=handles, loc="outside lower center", ncols=len(methods))
    return drawn
