"""Growth with the horizon as a table, and as a chart: gradient norms above, variances of both orders below."""

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
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, LogLocator, NullLocator

from bench.grid import Experiment
from bench.report.figures import save, styled
from bench.report.page import WIDTH
from bench.report.scales import log_axis
from bench.report.style import PALETTE, plain
from bench.report.tables import plain_markdown
from bench.report.views import axis_value, number, ran
from bench.store import write_whole

NORM: dict[str, Any] = {"color": "#000000", "marker": "o"}
VARIANCES: dict[str, tuple[str, dict[str, Any]]] = {
    "first_order": ("fobg", {"color": PALETTE[2], "marker": "D"}),
    "zeroth_order": ("zeroth order", {"color": PALETTE[5], "marker": "P", "linestyle": (0, (4, 1.5))}),
}
CLASSES = {"exploding": "#000000", "neutral": "#404040", "vanishing": PALETTE[0]}
"""Colours of the names of growth classes."""
PROBLEM = ["scene", "contact", "integrator", "backend", "dt", "stiffness", "sigma", "smoothing"]
NOTES = (
    "|grad|: norm of one sample's gradient, median and 5% to 95% of the noise samples. growth: log of the largest "
    "singular value (stretch) and of the spectral radius of the Jacobian product dx_N/dx_0, per second, mean and 95% "
    "interval over noise samples. exploding: the spectral radius surely grows; vanishing: the stretch surely falls. "
    "gain: largest singular value of dx_N/du_0 (dx_N/dx_1 without controls), median. variance: per sample, median over "
    "repeats.",
)


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``growth`` (.csv, .md, .png, .svg) and print the table."""
    table = readable(rows)
    texts = [f"# {experiment.name}: growth of gradients with the horizon", plain_markdown(table), *NOTES]
    contents = {
        "growth.csv": rows.to_csv(index=False, lineterminator="\n"),
        "growth.md": "\n\n".join(texts) + "\n",
    }
    paths = [experiment.directory / name for name in contents]
    for path, content in zip(paths, contents.values(), strict=True):
        write_whole(path, content.encode())
    with styled():
        drawn = figure(ran(rows))
    if drawn is not None:
        paths += save(drawn, experiment.directory / "growth")
    _print(experiment, rows, table)
    return paths


# ------------------------------------------------------------------------------------------------------- table


def readable(rows: pd.DataFrame) -> pd.DataFrame:
    """A table of texts, a line per cell in order of scene and horizon."""
    lines = []
    rows = rows.assign(place=rows["scene"].map({s: i for i, s in enumerate(rows["scene"].unique())}))
    for row in rows.sort_values(["place", "time_horizon"], kind="stable").to_dict("records"):
        line = {"scene": row["scene"], "contact": row["contact"], "steps": axis_value(row["horizon"])}
        line["T [s]"] = axis_value(row["time_horizon"])
        line["|grad| [5%, 95%]"] = _interval(row, "gradient_median", "gradient_low", "gradient_high")
        for kind in ("stretch", "spectral"):
            line[f"{kind} [1/s]"] = _interval(row, f"{kind}_rate", f"{kind}_low", f"{kind}_high", 1.0 / row["dt"])
        line["growth"] = row["growth"]
        line["gain"] = number(row["gain"][-1]) if len(row["gain"]) else "-"
        line["var fobg"] = number(row["first_order_variance"])
        line["var zeroth"] = number(row["zeroth_order_variance"])
        line["status"] = row["status"]
        lines.append(line)
    return pd.DataFrame(lines)


def _interval(row: Any, middle: str, low: str, high: str, factor: float = 1.0) -> str:
    values = [row[name] * factor for name in (middle, low, high)]
    if not math.isfinite(values[0]):
        return "-"
    return "{} [{}, {}]".format(*map(number, values))


def _print(experiment: Experiment, rows: pd.DataFrame, table: pd.DataFrame) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = max(console.width, 180)
    counts = ", ".join(f"{n} {status}" for status, n in rows["status"].value_counts().items())
    console.print(f"\n{experiment.name}: {experiment.question}\n{len(rows)} cells: {counts}")
    shown = Table(box=None, padding=(0, 2, 0, 0))
    for name in table:
        shown.add_column(name, justify="left" if name in ("scene", "contact", "growth", "status") else "right")
    for row in table.to_numpy():
        shown.add_row(*map(str, row))
    console.print(shown)
    for reason in rows.loc[rows["reason"] != "", "reason"].unique():
        console.print(reason)
    console.print(*NOTES)


# ------------------------------------------------------------------------------------------------------- chart


def figure(rows: pd.DataFrame) -> Figure | None:
    """A column of panels per problem: the norm of a sample's gradient above, variances per sample below."""
    groups = [part.sort_values("time_horizon") for _, part in rows.groupby(PROBLEM, dropna=False, sort=False)]
    groups = [part for part in groups if np.isfinite(part["gradient_median"]).any()]
    if not groups:
        return None
    found = Figure(figsize=(max(WIDTH, 1.45 * len(groups)), 4.4), layout="constrained")
    FigureCanvasAgg(found)
    found.suptitle("Growth of sampled gradients with the horizon", fontsize=9, fontweight="bold")
    grid = found.subplots(2, len(groups), squeeze=False, sharey="row")
    for (upper, lower), part in zip(grid.T, groups, strict=True):
        _draw_norms(upper, part)
        _draw_variances(lower, part)
        lower.set_xlabel("horizon [s]")
        for panel in (upper, lower):
            times = part["time_horizon"]
            log_axis(panel, "x", times.min() / 1.25, times.max() * 1.25)
    grid[0, 0].set_ylabel("norm of one sample's gradient")
    grid[1, 0].set_ylabel("variance per sample")
    for row in grid:
        _decades(row)
    handles: list[Any] = [Line2D([], [], label="median over noise samples", **NORM)]
    handles.append(Patch(label="5% to 95%", color="#000000", alpha=0.2, linewidth=0))
    handles += [Line2D([], [], label=f"variance of {name}", **style) for name, style in VARIANCES.values()]
    found.legend(handles=handles, loc="outside lower center", ncols=4, columnspacing=1.2)
    return found


def _draw_norms(panel: Axes, rows: pd.DataFrame) -> None:
    """Median norms in their band, titled with the problem and what becomes of its Jacobian product."""
    shown = rows[rows["gradient_median"] > 0]
    panel.fill_between(
        shown["time_horizon"], shown["gradient_low"], shown["gradient_high"], color="#000000", alpha=0.2, linewidth=0
    )
    panel.plot(shown["time_horizon"], shown["gradient_median"], **NORM)
    last = rows.iloc[-1]
    panel.set_title(plain(last["scene"]), pad=15)
    text = last["growth"]
    if text == "exploding":
        text = f"{text}, {last['spectral_rate'] / last['dt']:.2g}/s"
    elif text == "vanishing":
        text = f"{text}, {last['stretch_rate'] / last['dt']:.2g}/s"
    panel.text(
        0.5,
        1.02,
        text,
        transform=panel.transAxes,
        ha="center",
        va="bottom",
        color=CLASSES.get(last["growth"], "#404040"),
    )
    panel.tick_params(labelbottom=False)


def _draw_variances(panel: Axes, rows: pd.DataFrame) -> None:
    for name, (_, style) in VARIANCES.items():
        shown = rows[rows[f"{name}_variance"] > 0]
        low, high = (shown[f"{name}_variance_{end}"] for end in ("low", "high"))
        panel.fill_between(shown["time_horizon"], low, high, color=style["color"], alpha=0.2, linewidth=0)
        panel.plot(shown["time_horizon"], shown[f"{name}_variance"], **style)


def _decades(panels: Any) -> None:
    """One logarithmic scale for a row of panels, labelled every few decades."""
    for panel in panels:
        panel.set_yscale("log")
    low, high = np.log10(panels[0].get_ylim())
    every = max(1, math.ceil((high - low) / 7))
    ticks = 10.0 ** np.arange(math.ceil(low / every) * every, high, every)
    for panel in panels:
        panel.yaxis.set_major_locator(FixedLocator(list(ticks)) if len(ticks) > 1 else LogLocator())
        panel.yaxis.set_minor_locator(NullLocator())
