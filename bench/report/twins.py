"""Twins as a table, and as a chart: the trajectory of each scene's own program and those of the engines on it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.grid import Experiment
from bench.report.figures import save, styled
from bench.report.page import WIDTH, columns
from bench.report.style import PALETTE, plain
from bench.report.tables import plain_markdown
from bench.report.views import number, ran
from bench.store import write_whole

OWN: dict[str, Any] = {"color": "#b0b0b0", "linewidth": 4.0, "solid_capstyle": "round"}
STYLES: tuple[dict[str, Any], ...] = (
    {"color": PALETTE[0], "linewidth": 1.6},
    {"color": PALETTE[2], "linewidth": 1.0, "linestyle": (0, (4, 3))},
    {"color": PALETTE[3], "linewidth": 1.0, "linestyle": (0, (1, 2))},
    {"color": PALETTE[4], "linewidth": 1.0, "linestyle": (0, (6, 2, 1, 2))},
)
HEADERS = {
    "state_difference": "states", "state_difference_rel": "relative", "cost_difference_rel": "cost",
    "gradient_difference_rel": "gradient", "gradient_cosine": "cosine", "value_s": "value [s]",
    "gradient_s": "gradient [s]", "trace_s": "trace [s]", "lower_s": "lower [s]", "compile_s": "compile, in all [s]",
}  # fmt: skip
PRINTED = ("scene", "backend", "state_difference", "gradient_difference_rel", "value_s", "gradient_s", "compile_s")
"""Columns that the terminal has room for."""
NOTES = (
    "Differences of the engine's twin from the scene's own program at theta without noise: states, the largest over the "
    "rollout, and in units of what that coordinate reaches; cost and gradient, relative. value, gradient: one batch of "
    "`samples` rollouts. trace, lower: parts of what compiling the gradient took in all.",
)


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``twins`` (.csv, .md, .png, .svg) and print the table."""
    table = readable(rows)
    contents = {
        "twins.csv": rows.drop(columns=["path", "own_path"], errors="ignore").to_csv(index=False, lineterminator="\n"),
        "twins.md": "\n\n".join([f"# {experiment.name}: engines beside the scenes' own programs",
                                 plain_markdown(table, HEADERS), *NOTES]) + "\n",
    }  # fmt: skip
    paths = [experiment.directory / name for name in contents]
    for path, content in zip(paths, contents.values(), strict=True):
        write_whole(path, content.encode())
    found = rows[rows["status"] == "ok"]
    if not found.empty:
        with styled():
            paths += save(figure(found), experiment.directory / "twins")
    _print(experiment, rows, table)
    return paths


def readable(rows: pd.DataFrame) -> pd.DataFrame:
    """A table of texts, a line per scene and engine; a status where there are no numbers."""
    lines = []
    for row in ran(rows).to_dict("records"):
        numbers = {name: number(row[name], 3) for name in HEADERS}
        if row["status"] != "ok":
            numbers = dict.fromkeys(HEADERS, "") | {"state_difference": row["status"]}
        lines.append({"scene": row["scene"], "contact": row["contact"], "backend": row["backend"], **numbers})
    return pd.DataFrame(lines, columns=["scene", "contact", "backend", *HEADERS])


def figure(rows: pd.DataFrame) -> Figure:
    """A panel per scene: its coordinates over time, broad by its own program and thin by each engine."""
    problems = list(rows.groupby(["scene", "contact", "integrator"], sort=False))
    engines = list(dict.fromkeys(rows["backend"]))
    across = columns(len(problems), 2)
    down = math.ceil(len(problems) / across)
    drawn = Figure(figsize=(WIDTH, 1.9 * down + 0.5), layout="constrained")
    FigureCanvasAgg(drawn)
    panels = drawn.subplots(down, across, squeeze=False).ravel()
    for panel, (_, part) in zip(panels, problems, strict=False):
        _draw(panel, part, engines)
    for panel in panels[len(problems) :]:
        panel.axis("off")
    handles = [Line2D([], [], label="the scene's own program", **OWN)]
    handles += [Line2D([], [], label=plain(name), **STYLES[i % len(STYLES)]) for i, name in enumerate(engines)]
    drawn.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    drawn.suptitle("Engines on the trajectory of each scene", fontweight="bold", fontsize=9)
    return drawn


def _draw(panel: Axes, rows: pd.DataFrame, engines: list[str]) -> None:
    """One scene; the title says the largest difference of each engine."""
    first = rows.iloc[0]
    count = int(first["horizon"]) + 1
    time = np.arange(count) * first["dt"]
    panel.plot(time, np.reshape(first["own_path"], (count, -1)), **OWN)
    for row in rows.to_dict("records"):
        panel.plot(time, np.reshape(row["path"], (count, -1)), **STYLES[engines.index(row["backend"]) % len(STYLES)])
    off = ", ".join(f"{plain(row['backend'])} {number(row['state_difference'], 2)}" for row in rows.to_dict("records"))
    panel.set_title(f"{plain(first['scene'])}\nlargest difference: {off}", fontsize=7)
    panel.set_xlabel("time [s]")
    panel.set_ylabel("q")


def _print(experiment: Experiment, rows: pd.DataFrame, table: pd.DataFrame) -> None:
    from rich.console import Console
    from rich.table import Table

    grid = Table(box=None, title=f"{experiment.name}: engines beside the scenes' own programs", title_justify="left")
    for name in PRINTED:
        grid.add_column(HEADERS.get(name, name), no_wrap=True)
    for line in table[list(PRINTED)].itertuples(index=False):
        grid.add_row(*map(str, line))
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = max(console.width, 120)
    console.print(grid)
    for row in rows[rows["status"] != "ok"].to_dict("records"):
        print(f"{row['scene']}, {row['backend']}: {row['status']}: {row['reason']}")
