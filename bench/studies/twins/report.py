"""Writes twins as a table and a chart: how far each engine is from the scene's own program over the rollout."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.experiment.axes import table
from bench.experiment.experiment import Experiment
from bench.report.figures import save, styled
from bench.report.page import WIDTH, columns
from bench.report.scales import log_axis
from bench.report.style import colour, plain
from bench.report.tables import plain_markdown
from bench.report.text import number
from bench.report.views import Arranged, arranged, attempted
from bench.report.web.content import columns_of, distinguishing_columns, grouped, problems, shown_as
from bench.run.files import write_all

SMALL = 1e-17
"""Differences below this, 0 included, are drawn here."""
FAR = 1e-6
"""Relative difference of states from which a twin is named as different: rounding through a rollout stays below."""
COLOURS = tuple(map(colour, (0, 2, 3, 4, 5, 6, 7)))
DASHES: tuple[Any, ...] = ("-", (0, (4, 3)), (0, (1, 2)), (0, (6, 2, 1, 2)))
ENGINE = ("scene", "contact", "integrator", "backend")
"""What identifies a line of the table; other columns that vary are shown as well."""
HEADERS = {
    "state_difference": "states", "state_difference_rel": "relative", "cost_difference_rel": "cost",
    "gradient_difference_rel": "gradient", "gradient_cosine": "cosine", "value_s": "value [s]",
    "gradient_s": "gradient [s]", "trace_s": "trace [s]", "lower_s": "lower [s]", "compile_s": "compile, in all [s]",
}  # fmt: skip
PRINTED = ("state_difference", "gradient_difference_rel", "value_s", "gradient_s", "compile_s")
"""Results that fit on the terminal."""
NOTES = (
    "Differences of the engine's twin from the scene's own program at theta without noise: states, the largest over the "
    "rollout, and in units of what that coordinate reaches; cost and gradient, relative. value, gradient: one batch of "
    "`samples` rollouts. trace, lower: parts of what compiling the gradient took in all.",
)


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``twins`` (.csv, .md) and the chart."""
    shown = arranged(experiment, rows)
    title = f"# {experiment.name}: engines beside the scenes' own programs"
    contents = {
        "twins.csv": table(experiment, rows).to_csv(index=False, lineterminator="\n"),
        "twins.md": "\n\n".join([title, plain_markdown(readable(shown), HEADERS), *NOTES]) + "\n",
    }
    paths = write_all(experiment.directory, contents)
    if (rows["status"] == "ok").any():
        with styled():
            paths += save(figure(shown), experiment.directory / "twins", experiment.formats)
    return paths


def readable(shown: Arranged) -> pd.DataFrame:
    """Return a table of texts, a line per scene and engine; a status where there are no numbers."""
    rows = attempted(shown.rows)
    always = ("scene", "contact", "backend")
    named = distinguishing_columns(rows, grouped(rows, ENGINE), columns_of(shown, ENGINE), always)
    lines = []
    for row in rows.to_dict("records"):
        numbers = {name: number(row[name], 3) for name in HEADERS}
        if row["status"] != "ok":
            numbers = dict.fromkeys(HEADERS, "") | {"state_difference": row["status"]}
        lines.append({name: shown_as(row[name]) for name in named} | numbers)
    return pd.DataFrame(lines, columns=[*named, *HEADERS])


def figure(shown: Arranged) -> Figure:
    """Draw a panel per problem: the largest difference of any coordinate from its own program over time, by engine."""
    rows = shown.rows[shown.rows["status"] == "ok"]
    rows = rows.assign(engine=problems(shown, ["backend"], always=["backend"], rows=rows))
    titles = problems(shown, ["scene", "contact", "integrator"], rows=rows)
    parts = list(rows.groupby(titles, sort=False))
    engines = list(dict.fromkeys(rows["engine"]))
    across = columns(len(parts), 2)
    down = math.ceil(len(parts) / across)
    drawn = Figure(figsize=(WIDTH, 1.9 * down + 0.5), layout="constrained")
    FigureCanvasAgg(drawn)
    panels = drawn.subplots(down, across, squeeze=False, sharey=True).ravel()
    for panel, (title, part) in zip(panels, parts, strict=False):
        _draw(panel, str(title), part, engines)
    for panel in panels[len(parts) :]:
        panel.axis("off")
    handles = [Line2D([], [], label=plain(name), **_style(i)) for i, name in enumerate(engines)]
    drawn.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    drawn.suptitle("\n".join(textwrap.wrap(headline(rows, titles), 90)), fontweight="bold", fontsize=9)
    return drawn


def headline(rows: pd.DataFrame, titles: pd.Series) -> str:
    """Write on which problems an engine is another program, the furthest first, and where all are the same."""
    worst = rows["state_difference_rel"].groupby(titles, sort=False).max().sort_values(ascending=False)
    away = [f"{title} ({number(value)})" for title, value in worst.items() if value > FAR]
    if not away:
        return f"The engines follow each scene's own program to {number(float(worst.max()))} of its states"
    same = int((worst <= FAR).sum())
    return f"Other states than the scene's own program, relative: {', '.join(away)}; the same on {same} of {len(worst)}"


def _style(place: int) -> dict[str, Any]:
    """Return the colour and dashes of an engine; the first is drawn broader, below the others."""
    return {
        "color": COLOURS[place % len(COLOURS)], "linewidth": 1.0 if place else 1.6, "linestyle": DASHES[place % len(DASHES)]
    }  # fmt: skip


def _draw(panel: Axes, title: str, rows: pd.DataFrame, engines: list[str]) -> None:
    """Draw one problem; the title gives the largest difference of each engine."""
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
    """Print the table, and the reason of each cell that has no numbers."""
    from rich.console import Console
    from rich.table import Table

    lines = readable(arranged(experiment, rows))
    named = [name for name in lines if name not in HEADERS and name != "contact"]
    grid = Table(box=None, title=f"{experiment.name}: engines beside the scenes' own programs", title_justify="left")
    for name in (*named, *PRINTED):
        grid.add_column(HEADERS.get(name, name), no_wrap=True)
    for line in lines[[*named, *PRINTED]].itertuples(index=False):
        grid.add_row(*map(str, line))
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = max(console.width, 120)
    console.print(grid)
    for row in rows[rows["status"] != "ok"].to_dict("records"):
        print(f"{row['scene']}, {row['backend']}: {row['status']}: {row['reason']}")
