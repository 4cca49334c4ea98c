"""Draws the gradient checks as a matrix of verdicts: a row per problem, a column per horizon and point."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from bench.experiment.experiment import Experiment
from bench.measure.gradcheck import BROKEN, FAULTS, TRUSTED, UNDECIDED, VERDICTS
from bench.report.figures import save, styled
from bench.report.page import WIDTH
from bench.report.study_tables import titled_figure
from bench.report.style import PALETTE, plain
from bench.report.text import counted
from bench.report.views import Arranged, arrange
from bench.run.files import write_whole
from bench.studies.gradient_check.points import POINTS, is_trusted
from bench.studies.gradient_check.report import by_point, problem_of

BLUE, BLACK, RED, GREEN, PINK, ORANGE, SKY, _ = PALETTE
KINDS: dict[str, tuple[tuple[str, ...], str, str]] = {
    "X": (FAULTS, RED, "not the derivative of its cost"),
    "?": (UNDECIDED, "#bdbdbd", "undecided"),
    "J": (("jump",), PINK, "the cost jumps here"),
    "K": (tuple(name for name in BROKEN if name != "jump"), ORANGE, "kink: at most a one-sided slope"),
    "ok": (TRUSTED, "#cfe8df", "right"),
}
"""Verdicts, colour and meaning of each letter in a cell, the worst first."""
ROW = 0.17
"""Height of a row in inches."""


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write the matrix as ``gradient_check``, unless nothing was checked; return the files' paths.

    The plotted data have a line per row and point.
    """
    shown = arrange(experiment, rows)
    table = by_point(rows)
    if table.empty:
        return []
    with styled():
        paths = save(figure(shown), experiment.directory / "gradient_check", experiment.formats)
    # plotted data cannot be read back from the matrix: write the verdicts that it shows
    write_whole(paths[-1], table.drop(columns=["row", "rank"]).to_csv(index=False, lineterminator="\n").encode())
    return paths


def figure(shown: Arranged) -> Figure:
    """Draw the worst verdict of each problem (rows), at each horizon and point (columns), over backends and checks."""
    table = by_point(shown.rows)
    table = table.assign(name=problem_of(shown).to_numpy()[table["row"].astype(int)])
    names = list(dict.fromkeys(table["name"]))
    horizons = sorted(table["horizon"].unique())
    points = [point for point in POINTS if point in set(table["point"])]
    columns = [(horizon, point) for horizon in horizons for point in points]
    drawn = titled_figure(WIDTH, 1.5 + ROW * (len(names) + 1), headline(table))
    panel = drawn.subplots()
    for (name, horizon, point), part in table.groupby(["name", "horizon", "point"], sort=False):
        verdict = min(part["verdict"], key=VERDICTS.index)
        letter = next(letter for letter, (verdicts, _, _) in KINDS.items() if verdict in verdicts)
        place = columns.index((horizon, point)) + 0.35 * horizons.index(horizon)
        height = len(names) - 1 - names.index(str(name))
        look: dict[str, Any] = {"facecolor": KINDS[letter][1], "edgecolor": "white", "linewidth": 0.6}
        panel.add_patch(Rectangle((place, height), 1, 1, **look))
        colour = "white" if letter == "X" else "black"
        panel.text(place + 0.5, height + 0.45, letter, ha="center", va="center", fontsize=6.5, color=colour)
    panel.set(xlim=(0, len(columns) + 0.35 * (len(horizons) - 1)), ylim=(0, len(names)))
    panel.set_yticks(np.arange(len(names)) + 0.5, [plain(name) for name in reversed(names)], fontsize=7)
    panel.set_xticks(
        [i + 0.5 + 0.35 * horizons.index(horizon) for i, (horizon, _) in enumerate(columns)],
        [point for _, point in columns], fontsize=6.5, rotation=60 if len(columns) > 8 else 0,
    )  # fmt: skip
    panel.tick_params(length=0)
    for side in panel.spines.values():
        side.set_visible(False)
    for i, horizon in enumerate(horizons):
        middle = i * (len(points) + 0.35) + len(points) / 2
        panel.text(middle, len(names) + 0.15, _steps(int(horizon)), ha="center", va="bottom")
    used = {letter for letter, (verdicts, _, _) in KINDS.items() if table["verdict"].isin(verdicts).any()}
    legend = [
        Patch(facecolor=fill, label=f"{letter}: {text}") for letter, (_, fill, text) in KINDS.items() if letter in used
    ]
    legend += [Patch(facecolor="white", label="blank: no switch of contact was found")] * (len(points) > 1)
    drawn.legend(handles=legend, loc="outside lower center", ncols=3, columnspacing=1.2)
    return drawn


def _steps(horizon: int) -> str:
    return "no steps" if horizon == 0 else counted(horizon, "step")


def headline(table: pd.DataFrame) -> str:
    """Format the title of the matrix: problems with wrong gradients, then the number with other untrusted checks."""
    faults = table[table["verdict"].isin(FAULTS)]
    undecided = [
        not is_trusted(point, verdict) and verdict not in FAULTS
        for point, verdict in zip(table["point"], table["verdict"], strict=True)
    ]
    parts = []
    if len(faults):
        parts.append(f"Wrong gradients: {', '.join(dict.fromkeys(faults['name']))}")
    if any(undecided):
        n_problems = table.loc[undecided, "name"].nunique()
        parts.append(f"kinks, jumps or undecided checks in {n_problems} of {table['name'].nunique()} problems")
    if not parts:
        return "Away from contact switches, every gradient is the derivative of its program's cost"
    return "; ".join(parts if len(faults) else ["No gradient is wrong for its program", *parts])
