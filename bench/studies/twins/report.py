"""Writes the table and the chart of twins: differences between each engine and the scene's own program over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
from bench.report.style import colour, plain
from bench.report.tables import plain_markdown
from bench.report.text import number
from bench.report.views import Arranged, arrange, attempted

SMALL = 1e-17
"""Smallest difference that is drawn; smaller ones, 0 included, are drawn at this value."""
DIFFERENT = 1e-6
"""Relative difference of states above which a twin counts as different. Accumulated rounding errors are smaller."""
COLOURS = tuple(map(colour, (0, 2, 3, 4, 5, 6, 7)))
DASHES: tuple[Any, ...] = ("-", (0, (4, 3)), (0, (1, 2)), (0, (6, 2, 1, 2)))
ENGINE = ("scene", "contact", "integrator", "backend")
"""Parts of the grid that identify a line of the table."""
HEADERS = {
    "state_difference": "states", "state_difference_rel": "relative", "cost_difference_rel": "cost",
    "gradient_difference_rel": "gradient", "gradient_cosine": "cosine", "value_s": "value [s]",
    "gradient_s": "gradient [s]", "trace_s": "trace [s]", "lower_s": "lower [s]", "compile_s": "compile, in all [s]",
}  # fmt: skip
PRINTED = ("state_difference", "gradient_difference_rel", "value_s", "gradient_s", "compile_s")
"""Result columns printed on the terminal."""
NOTES = (
    "Differences between the engine's twin and the scene's own program at theta without noise. states: the largest over "
    "the rollout. relative: in units of the coordinate's largest value. cost, gradient: relative. value [s], gradient [s]: "
    "one batch of `samples` rollouts. trace, lower: parts of the time to compile the gradient.",
)


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``twins`` (.csv, .md) and the chart."""
    shown = arrange(experiment, rows)
    title = f"# {experiment.name}: engines compared with the scenes' own programs"
    paths = write_tables(experiment, rows, "twins", [title, plain_markdown(readable(shown), HEADERS), *NOTES])
    if (rows["status"] == "ok").any():
        with styled():
            paths += save(figure(shown), experiment.directory / "twins", experiment.formats)
    return paths


def readable(shown: Arranged) -> pd.DataFrame:
    """Return the table as strings, a line per scene and engine; a cell without numbers shows its status."""
    rows = attempted(shown.rows)
    labels = label_columns(shown, ENGINE, always=("scene", "contact", "backend"), rows=rows)
    lines = []
    for row in rows.to_dict("records"):
        numbers = {name: number(row[name], 3) for name in HEADERS}
        if row["status"] != "ok":
            numbers = dict.fromkeys(HEADERS, "") | {"state_difference": row["status"]}
        lines.append({name: value_text(row[name]) for name in labels} | numbers)
    return pd.DataFrame(lines, columns=[*labels, *HEADERS])


def figure(shown: Arranged) -> Figure:
    """Draw, in a panel per problem, the largest difference of any position from the own program's, over time [s]."""
    rows = shown.rows[shown.rows["status"] == "ok"]
    rows = rows.assign(engine=problem_names(shown, ["backend"], always=["backend"], rows=rows))
    titles = problem_names(shown, ["scene", "contact", "integrator"], rows=rows)
    parts = list(rows.groupby(titles, sort=False))
    engines = list(dict.fromkeys(rows["engine"]))
    drawn, panels = panel_grid(len(parts), 2, 1.9, headline(rows, titles), margin=0.5, sharey=True)
    for panel, (title, part) in zip(panels, parts, strict=True):
        _draw(panel, str(title), part, engines)
    handles = [Line2D([], [], label=plain(name), **_style(i)) for i, name in enumerate(engines)]
    drawn.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return drawn


def headline(rows: pd.DataFrame, titles: pd.Series) -> str:
    """Format on which problems an engine's states differ from the own program's, and on how many problems they agree."""
    worst = rows["state_difference_rel"].groupby(titles, sort=False).max().sort_values(ascending=False)
    different = [f"{title} ({number(value)})" for title, value in worst.items() if value > DIFFERENT]
    if not different:
        return f"Engines and own programs agree: largest relative difference of states {number(float(worst.max()))}"
    n_equal = int((worst <= DIFFERENT).sum())
    return (
        f"Relative difference of states between engine and own program: {', '.join(different)}; "
        f"none on {n_equal} of {len(worst)} problems"
    )


def _style(place: int) -> dict[str, Any]:
    """Return the line style of an engine. The first engine's line is the widest, so that others do not hide it."""
    return {
        "color": COLOURS[place % len(COLOURS)], "linewidth": 1.0 if place else 1.6, "linestyle": DASHES[place % len(DASHES)]
    }  # fmt: skip


def _draw(panel: Axes, title: str, rows: pd.DataFrame, engines: list[str]) -> None:
    """Draw one problem's panel, with the largest difference of each engine in its title."""
    first = rows.iloc[0]
    count = int(first["horizon"]) + 1
    time = np.arange(count) * first["dt"]
    own = np.reshape(first["own_path"], (count, -1))
    for row in rows.to_dict("records"):
        apart = np.abs(np.reshape(row["path"], (count, -1)) - own).max(axis=1)
        panel.plot(time, apart.clip(SMALL), **_style(engines.index(row["engine"])))
    log_axis(panel, "y", SMALL / 3, 10.0)
    off = ", ".join(f"{plain(row['engine'])} {number(row['state_difference'], 2)}" for row in rows.to_dict("records"))
    panel.set_title(f"{plain(title)}\nlargest difference: {off}", fontsize=7)
    panel.set_xlabel("time [s]")
    panel.set_ylabel("largest |Δq|")


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the table, and the reason of each cell without numbers."""
    console = open_console(experiment, rows)
    texts = readable(arrange(experiment, rows))
    labels = [name for name in texts if name not in HEADERS and name != "contact"]
    print_table(console, texts[[*labels, *PRINTED]], HEADERS)
    for row in rows[rows["status"] != "ok"].to_dict("records"):
        console.print(f"{row['scene']}, {row['backend']}: {row['status']}: {row['reason']}")
