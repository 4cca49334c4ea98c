"""Writes the table, the chart and the page of the solver's iterations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.experiment.experiment import Experiment
from bench.report.figures import save, styled
from bench.report.problems import problem_names, value_text
from bench.report.scales import log_axis
from bench.report.study_tables import label_columns, open_console, panel_grid, print_table, write_tables
from bench.report.style import MARKERS, colour, plain
from bench.report.tables import plain_markdown
from bench.report.text import number
from bench.report.views import Arranged, arrange, attempted
from bench.report.web import generic
from bench.report.web.content import Content, no_result_sentence

SMALL = 1e-16
"""Smallest relative error that is drawn; smaller ones, 0 included, are drawn at this value."""
ENGINE = ("scene", "contact", "integrator", "backend")
HEADERS = {
    "solver_residual": "residual", "gradient_error_rel": "error", "gradient_cosine": "cosine",
    "wrong_signs": "wrong signs", "gradient_s": "gradients [s]", "compile_s": "compile [s]",
}  # fmt: skip
NOTES = (
    "Gradients at theta without noise, compared with the gradient of the same program with a converged solver. residual: of "
    "the solver, relative to the forces of a step. error: relative. wrong signs: share of coordinates. gradients [s]: one "
    "batch of `samples` rollouts.",
)


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``solver`` (.csv, .md) and the chart."""
    shown = arrange(experiment, rows)
    title = f"# {experiment.name}: gradients along the iterations of the constraint solver"
    table = plain_markdown(readable(shown), HEADERS)
    paths = write_tables(experiment, rows, "solver", [title, finding(rows), table, *NOTES])
    if (rows["status"] == "ok").any():
        with styled():
            paths += save(figure(shown), experiment.directory / "solver", experiment.formats)
    return paths


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the table, and the reason of each cell without numbers."""
    console = open_console(experiment, rows)
    print_table(console, readable(arrange(experiment, rows)), HEADERS)
    console.print(finding(rows))
    for row in rows[rows["status"] != "ok"].to_dict("records"):
        console.print(f"{row['scene']}, {row['backend']}: {row['status']}: {row['reason']}")


def content(experiment: Experiment, rows: pd.DataFrame) -> Content:
    """Return the content of the page: the finding, a chart of any two numbers, and the table."""
    return replace(generic.content(experiment, rows), finding=no_result_sentence(rows) or finding(rows))


def finding(rows: pd.DataFrame) -> str:
    """Format the error and the wrong signs at the fewest iterations, and the iterations that suffice, per scene."""
    good = rows[rows["status"] == "ok"]
    sentences = []
    for scene, part in good.groupby("scene", sort=False):
        worst = part.loc[part["gradient_error_rel"].idxmax()]
        sentence = (
            f"{scene}: with {worst['iterations']:g} iteration{'s' if worst['iterations'] > 1 else ''} ({worst['backend']}) "
            f"the gradient has a relative error of {number(worst['gradient_error_rel'])}, a cosine of "
            f"{number(worst['gradient_cosine'])} and {worst['wrong_signs']:.0%} wrong signs"
        )
        converged = part[part["gradient_error_rel"] < 1e-6]
        if len(converged):
            sentence += f"; from {converged['iterations'].min():g} iterations on, errors below 1e-6 occur"
        sentences.append(sentence)
    return ". ".join(sentences) + "." if sentences else ""


def readable(shown: Arranged) -> pd.DataFrame:
    """Return the table as strings, a line per scene, engine and iterations; other cells show their status."""
    rows = attempted(shown.rows)
    labels = label_columns(shown, ENGINE, always=("scene", "backend"), rows=rows)
    lines = []
    for row in rows.to_dict("records"):
        numbers = {name: number(row[name], 3) for name in HEADERS}
        if row["status"] != "ok":
            numbers = dict.fromkeys(HEADERS, "") | {"gradient_error_rel": row["status"]}
        lines.append({name: value_text(row[name]) for name in labels} | numbers)
    return pd.DataFrame(lines, columns=[*labels, *HEADERS])


def figure(shown: Arranged) -> Figure:
    """Draw, in a panel per scene, the relative error of the gradient along the iterations, a line per backend."""
    rows = shown.rows[shown.rows["status"] == "ok"]
    rows = rows.assign(engine=problem_names(shown, ["backend"], shown.axes, always=["backend"], rows=rows))
    titles = problem_names(shown, ["scene", "contact", "integrator"], rows=rows)
    engines = list(dict.fromkeys(rows["engine"]))
    parts = list(rows.groupby(titles, sort=False))
    title = "Error of the gradient to the program with a converged solver, along the solver's iterations"
    drawn, panels = panel_grid(len(parts), 3, 2.1, title, margin=0.6, sharey=True)
    for panel, (name, part) in zip(panels, parts, strict=True):
        _draw(panel, str(name), part, engines)
    handles = [Line2D([], [], label=plain(name), color=colour(i), marker=MARKERS[i]) for i, name in enumerate(engines)]
    drawn.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return drawn


def _draw(panel: Axes, title: str, rows: pd.DataFrame, engines: list[str]) -> None:
    """Draw one scene's panel. Gradients with wrong signs have a cross on their marker."""
    for name, part in rows.groupby("engine", sort=False):
        i = engines.index(str(name))
        line = part.sort_values("iterations")
        error = np.maximum(line["gradient_error_rel"], SMALL)
        panel.plot(line["iterations"], error, color=colour(i), marker=MARKERS[i])
        wrong = line["wrong_signs"] > 0
        panel.plot(line["iterations"][wrong], error[wrong], "x", color="black", markersize=8)
    panel.set_xscale("log")
    log_axis(panel, "y", SMALL / 3, 100.0)
    panel.set_title(plain(title), fontsize=7)
    panel.set_xlabel("iterations")
    panel.set_ylabel("relative error (x: wrong signs)")
