"""Writes growth with the horizon as a table and a chart: gradient norms, the Jacobian product, variances."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, LogLocator, NullLocator

from bench.experiment.axes import table
from bench.experiment.experiment import Experiment
from bench.report.colours import ink
from bench.report.figures import save, styled
from bench.report.page import WIDTH
from bench.report.scales import log_axis
from bench.report.style import PALETTE, plain
from bench.report.tables import plain_markdown
from bench.report.text import axis_value, counted, number
from bench.report.views import Arranged, arranged, attempted
from bench.report.web.content import columns_of, distinguishing_columns, grouped, problems, shown_as, together
from bench.run.files import write_all

NORM: dict[str, Any] = {"color": "#000000", "marker": "o"}
SINGULAR: tuple[dict[str, Any], ...] = (
    {"color": PALETTE[2], "marker": "^", "markersize": 3.5},
    {"color": PALETTE[0], "marker": "v", "markersize": 3.5},
    {"color": "#808080", "linewidth": 0.8},
)
"""The looks of the largest singular value, the smallest and those between."""
CLASSES = {"exploding": PALETTE[2], "neutral": "#404040", "vanishing": PALETTE[0]}
"""Colours of the names of growth classes."""
PROBLEM = ("scene", "contact", "integrator", "backend")
"""What a problem is made of; it is drawn along the horizon and along axes that step with the horizon."""
ROUNDING = float(np.finfo(np.float64).eps)
"""Share of a matrix's largest singular value below which the others are rounding."""
NOTES = (
    "|grad|: norm of one sample's gradient, median and 5% to 95% of the noise samples. growth: log of the largest "
    "singular value (stretch) and of the spectral radius of the Jacobian product dx_N/dx_0, per second, mean and 95% "
    "interval over noise samples. exploding: the spectral radius surely grows; vanishing: the stretch surely falls. "
    "singular values: largest and smallest of that product, median. gain: largest singular value of dx_N/du_0 (dx_N/dx_1 "
    "without controls), median. variance: per sample, median over "
    "repeats.",
)


def variances() -> dict[str, tuple[str, dict[str, Any]]]:
    """Return, by column, the name and the look of the curves of variance."""
    return {
        "first_order": ("fobg", {"color": ink("fobg"), "marker": "D"}),
        "zeroth_order": ("zeroth order", {"color": ink("reinforce"), "marker": "P", "linestyle": (0, (4, 1.5))}),
    }


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``growth`` (.csv, .md) and the chart."""
    shown = arranged(experiment, rows)
    texts = [f"# {experiment.name}: growth of gradients with the horizon", plain_markdown(readable(shown)), *NOTES]
    contents = {
        "growth.csv": table(experiment, rows).to_csv(index=False, lineterminator="\n"),
        "growth.md": "\n\n".join(texts) + "\n",
    }
    paths = write_all(experiment.directory, contents)
    with styled():
        drawn = figure(shown)
    if drawn is not None:
        paths += save(drawn, experiment.directory / "growth", experiment.formats)
    return paths


# ------------------------------------------------------------------------------------------------------- table


def problem_of(shown: Arranged, rows: pd.DataFrame | None = None) -> pd.Series:
    """Return, per row, the name of its problem, the same at every horizon."""
    return problems(shown, PROBLEM, together(shown, "horizon"), rows=rows)


def named(shown: Arranged) -> list[str]:
    """Return the columns that distinguish the lines of the table, besides the horizon."""
    along = together(shown, "horizon")
    return distinguishing_columns(
        shown.rows, grouped(shown.rows, PROBLEM, along), columns_of(shown, PROBLEM, along), ("scene", "contact")
    )


def readable(shown: Arranged) -> pd.DataFrame:
    """Return a table of texts, a line per cell in order of scene and horizon."""
    lines = []
    columns = [name for name in named(shown) if name != "horizon"]
    rows = shown.rows.assign(place=shown.rows["scene"].map({s: i for i, s in enumerate(shown.rows["scene"].unique())}))
    for row in rows.sort_values(["place", "time_horizon"], kind="stable").to_dict("records"):
        line = {name: shown_as(row[name]) for name in columns} | {"steps": axis_value(row["horizon"])}
        line["T [s]"] = axis_value(row["time_horizon"])
        line["|grad| [5%, 95%]"] = _interval(row, "gradient_median", "gradient_low", "gradient_high")
        for kind in ("stretch", "spectral"):
            line[f"{kind} [1/s]"] = _interval(row, f"{kind}_rate", f"{kind}_low", f"{kind}_high", 1.0 / row["dt"])
        line["growth"] = row["growth"]
        line["singular values"] = _ends(row["singular_values"])
        line["gain"] = number(row["gain"][-1]) if len(row["gain"]) else "-"
        line["var fobg"] = number(row["first_order_variance"])
        line["var zeroth"] = number(row["zeroth_order_variance"])
        line["status"] = row["status"]
        lines.append(line)
    return pd.DataFrame(lines)


def _ends(values: Sequence[float]) -> str:
    """Return the largest and the smallest singular value, the latter at most as small as rounding can resolve."""
    if not len(values):
        return "-"
    floor = ROUNDING * values[0]
    return f"{number(values[0])} to " + (number(values[-1]) if values[-1] > floor else f"< {number(floor)}")


def _interval(row: Any, middle: str, low: str, high: str, factor: float = 1.0) -> str:
    values = [row[name] * factor for name in (middle, low, high)]
    if not math.isfinite(values[0]):
        return "-"
    return "{} [{}, {}]".format(*map(number, values))


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the table, and the reasons of cells without numbers."""
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = max(console.width, 180)
    counts = ", ".join(f"{n} {status}" for status, n in rows["status"].value_counts().items())
    console.print(f"\n{experiment.name}: {experiment.question}\n{counted(len(rows), 'cell')}: {counts}")
    lines = readable(arranged(experiment, rows))
    grid = Table(box=None, padding=(0, 2, 0, 0))
    for name in lines:
        grid.add_column(name, justify="left" if name in (*PROBLEM, "growth", "status") else "right")
    for line in lines.to_numpy():
        grid.add_row(*map(str, line))
    console.print(grid)
    for reason in rows.loc[rows["reason"] != "", "reason"].unique():
        console.print(reason)
    console.print(*NOTES)


# ------------------------------------------------------------------------------------------------------- chart


def grown(growths: Mapping[str, str]) -> str:
    """Write on which problems gradients explode and vanish; ``growths`` has the growth of each at its longest horizon."""
    parts = []
    for growth, verb in (("exploding", "explode"), ("vanishing", "vanish"), ("neutral", "do neither")):
        names = [name for name, found in growths.items() if found == growth]
        if names:
            parts.append(f"{verb} on {', '.join(names)}")
    return "Gradients through time " + ", ".join(parts)


def figure(shown: Arranged) -> Figure | None:
    """Draw a column of panels per problem: norms of sampled gradients, the Jacobian product, variances per sample."""
    rows = attempted(shown.rows)
    rows = rows[np.isfinite(rows["gradient_median"])]
    groups = [
        (str(name), part.sort_values("time_horizon"))
        for name, part in rows.groupby(problem_of(shown, rows), sort=False)
    ]
    if not groups:
        return None
    drawing = Figure(figsize=(max(WIDTH, 1.45 * len(groups)), 7.6), layout="constrained")
    FigureCanvasAgg(drawing)
    drawing.suptitle(
        textwrap.fill(grown({name: part["growth"].iloc[-1] for name, part in groups}), 92),
        fontsize=9,
        fontweight="bold",
    )
    grid = drawing.subplots(len(ROWS), len(groups), squeeze=False, sharey="row")
    for column, (name, part) in zip(grid.T, groups, strict=True):
        times = part["time_horizon"]
        for panel, (_, draw) in zip(column, ROWS, strict=True):
            draw(panel, part)
            log_axis(panel, "x", times.min() / 1.25, times.max() * 1.25)
            panel.tick_params(labelbottom=panel is column[-1])
        _draw_title(column[0], name, part)
        column[-1].set_xlabel("time [s]")
    for line, (label, _) in zip(grid, ROWS, strict=True):
        line[0].set_ylabel(label)
        _decades(line)
    drawing.legend(handles=_legend(), loc="outside lower center", ncols=3, columnspacing=1.2)
    return drawing


def _legend() -> list[Any]:
    handles: list[Any] = [Line2D([], [], label="median over noise samples", **NORM)]
    handles.append(Patch(label="5% to 95%", color="#000000", alpha=0.2, linewidth=0))
    names = ("largest singular value", "smallest", "between")
    handles += [Line2D([], [], label=name, **look) for name, look in zip(names, SINGULAR, strict=True)]
    handles += [Line2D([], [], label=f"variance of {name}", **style) for name, style in variances().values()]
    return handles


def _draw_title(panel: Axes, name: str, rows: pd.DataFrame) -> None:
    """Write the problem, and what becomes of its Jacobian product over the longest horizon."""
    last = rows.iloc[-1]
    panel.set_title("\n".join(map(plain, name.split(", "))), pad=15)
    text = last["growth"]
    if text in ("exploding", "vanishing"):
        rate = "spectral_rate" if text == "exploding" else "stretch_rate"
        text = f"{text}, {last[rate] / last['dt']:.2g}/s"
    colour = CLASSES.get(last["growth"], "#404040")
    panel.text(0.5, 1.02, text, transform=panel.transAxes, ha="center", va="bottom", color=colour, fontweight="bold")


def _draw_norms(panel: Axes, rows: pd.DataFrame) -> None:
    """Draw median norms in their band, at each horizon."""
    shown = rows[rows["gradient_median"] > 0]
    low, high = shown["gradient_low"], shown["gradient_high"]
    panel.fill_between(shown["time_horizon"], low, high, color="#000000", alpha=0.2, linewidth=0)
    panel.plot(shown["time_horizon"], shown["gradient_median"], **NORM)


def _draw_singular(panel: Axes, rows: pd.DataFrame) -> None:
    """Draw every singular value of dx_N/dx_0, at each horizon, and the value 1 between growing and fading."""
    values = np.array(rows["singular_values"].to_list(), dtype=float)
    values = np.where(values > ROUNDING * values[:, :1], values, np.nan)
    last = values.shape[1] - 1
    for i in range(last, -1, -1):
        panel.plot(rows["time_horizon"], values[:, i], **SINGULAR[0 if i == 0 else 1 if i == last else 2])
    _unity(panel)


def _draw_gain(panel: Axes, rows: pd.DataFrame) -> None:
    """Draw the gain of the longest horizon against the time by which a control, or a state, comes before the end."""
    row = rows.iloc[-1]
    times, (gain, low, high) = np.array(row["lags"]) * row["dt"], (row[f"gain{end}"] for end in ("", "_low", "_high"))
    panel.fill_between(times, low, high, color="#000000", alpha=0.2, linewidth=0)
    panel.plot(times, gain, **NORM | {"marker": ""})
    panel.text(0.04, 0.97, f"of {row['gain_of']}", transform=panel.transAxes, ha="left", va="top")
    if row["gain_of"] == "states":
        _unity(panel)


def _unity(panel: Axes) -> None:
    panel.axhline(1.0, color="#808080", linewidth=0.7, linestyle=(0, (1, 1.5)), zorder=1)


def _draw_variances(panel: Axes, rows: pd.DataFrame) -> None:
    for name, (_, style) in variances().items():
        shown = rows[rows[f"{name}_variance"] > 0]
        low, high = (shown[f"{name}_variance_{end}"] for end in ("low", "high"))
        panel.fill_between(shown["time_horizon"], low, high, color=style["color"], alpha=0.2, linewidth=0)
        panel.plot(shown["time_horizon"], shown[f"{name}_variance"], **style)


ROWS = (
    ("norm of one sample's\ngradient, by horizon", _draw_norms),
    ("singular values of\n$dx_N/dx_0$, by horizon", _draw_singular),
    ("gain to the end state,\nby time before it", _draw_gain),
    ("variance per sample,\nby horizon", _draw_variances),
)
"""The rows of panels: their labels, and the functions that draw them."""


def _decades(panels: Any) -> None:
    """Set one logarithmic scale for a row of panels, labelled every few decades."""
    for panel in panels:
        panel.set_yscale("log")
    low, high = np.log10(panels[0].get_ylim())
    every = max(1, math.ceil((high - low) / 7))
    ticks = 10.0 ** np.arange(math.ceil(low / every) * every, high, every)
    for panel in panels:
        panel.yaxis.set_major_locator(FixedLocator(list(ticks)) if len(ticks) > 1 else LogLocator())
        panel.yaxis.set_minor_locator(NullLocator())
