"""Writes the table and the chart of growth with the horizon: gradient norms, the Jacobian product, variances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from bench.experiment.experiment import Experiment
from bench.report.colours import estimator_colour
from bench.report.figures import save, styled
from bench.report.page import WIDTH
from bench.report.problems import axes_of, problem_names, value_text
from bench.report.scales import log_axis
from bench.report.study_tables import (
    interval,
    label_columns,
    open_console,
    print_reasons,
    print_table,
    titled_figure,
    write_tables,
)
from bench.report.style import PALETTE, plain
from bench.report.tables import plain_markdown
from bench.report.text import axis_value, number
from bench.report.views import Arranged, arrange, attempted

NORM: dict[str, Any] = {"color": "#000000", "marker": "o"}
SINGULAR: tuple[dict[str, Any], ...] = (
    {"color": PALETTE[2], "marker": "^", "markersize": 3.5},
    {"color": PALETTE[0], "marker": "v", "markersize": 3.5},
    {"color": "#808080", "linewidth": 0.8},
)
"""Line styles of the largest singular value, the smallest one, and all others."""
CLASSES = {"exploding": PALETTE[2], "neutral": "#404040", "vanishing": PALETTE[0]}
"""Colour of each growth class's name."""
PROBLEM = ("scene", "contact", "integrator", "backend")
"""Parts of the grid that identify a problem. It is drawn along the horizon and the axes that step with it."""
ROUNDING = float(np.finfo(np.float64).eps)
"""Share of the largest singular value up to which another singular value is a rounding error."""
NOTES = (
    "|grad|: norm of one sample's gradient, median and 5% to 95% of the noise samples. growth: log of the largest "
    "singular value (stretch) and of the spectral radius of the Jacobian product dx_N/dx_0, per second, mean and 95% "
    "interval over noise samples. exploding: the spectral radius certainly grows. vanishing: the stretch certainly falls. "
    "singular values: largest and smallest of that product, median. gain: largest singular value of dx_N/du_0 (dx_N/dx_1 "
    "without controls), median. variance: per sample, median over "
    "repeats.",
)


def variances() -> dict[str, tuple[str, dict[str, Any]]]:
    """Return the name and line style of each variance curve, by the prefix of its columns."""
    return {
        "first_order": ("fobg", {"color": estimator_colour("fobg"), "marker": "D"}),
        "zeroth_order": (
            "zeroth order",
            {"color": estimator_colour("reinforce"), "marker": "P", "linestyle": (0, (4, 1.5))},
        ),
    }


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``growth`` (.csv, .md) and the chart."""
    shown = arrange(experiment, rows)
    texts = [f"# {experiment.name}: growth of gradients with the horizon", plain_markdown(readable(shown)), *NOTES]
    paths = write_tables(experiment, rows, "growth", texts)
    with styled():
        drawn = figure(shown)
    if drawn is not None:
        paths += save(drawn, experiment.directory / "growth", experiment.formats)
    return paths


# ------------------------------------------------------------------------------------------------------- table


def problem_of(shown: Arranged, rows: pd.DataFrame | None = None) -> pd.Series:
    """Return, per row, the name of its problem, the same at every horizon."""
    return problem_names(shown, PROBLEM, axes_of(shown, "horizon"), rows=rows)


def readable(shown: Arranged) -> pd.DataFrame:
    """Return the table as strings, a line per cell, ordered by scene and horizon."""
    lines = []
    columns = [name for name in label_columns(shown, PROBLEM, axes_of(shown, "horizon")) if name != "horizon"]
    rows = shown.rows.assign(place=shown.rows["scene"].map({s: i for i, s in enumerate(shown.rows["scene"].unique())}))
    for row in rows.sort_values(["place", "time_horizon"], kind="stable").to_dict("records"):
        line = {name: value_text(row[name]) for name in columns} | {"steps": axis_value(row["horizon"])}
        line["T [s]"] = axis_value(row["time_horizon"])
        line["|grad| [5%, 95%]"] = interval(row, "gradient_median", "gradient_low", "gradient_high")
        for kind in ("stretch", "spectral"):
            line[f"{kind} [1/s]"] = interval(row, f"{kind}_rate", f"{kind}_low", f"{kind}_high", 1.0 / row["dt"])
        line["growth"] = row["growth"]
        line["singular values"] = _ends(row["singular_values"])
        line["gain"] = number(row["gain"][-1]) if len(row["gain"]) else "-"
        line["var fobg"] = number(row["first_order_variance"])
        line["var zeroth"] = number(row["zeroth_order_variance"])
        line["status"] = row["status"]
        lines.append(line)
    return pd.DataFrame(lines)


def _ends(values: Sequence[float]) -> str:
    """Format the largest and smallest singular value; the smallest as ``< u`` if it is below the rounding error u."""
    if not len(values):
        return "-"
    floor = ROUNDING * values[0]
    return f"{number(values[0])} to " + (number(values[-1]) if values[-1] > floor else f"< {number(floor)}")


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the table, and the reasons of cells without numbers."""
    console = open_console(experiment, rows)
    texts = readable(arrange(experiment, rows))
    print_table(console, texts, right=set(texts) - {*PROBLEM, "growth", "status"})
    print_reasons(console, rows)
    console.print(*NOTES)


# ------------------------------------------------------------------------------------------------------- chart


def headline(classes: Mapping[str, str]) -> str:
    """Format on which problems gradients explode or vanish; ``classes`` has each problem's class at its longest horizon."""
    parts = []
    for growth, verb in (("exploding", "explode"), ("vanishing", "vanish"), ("neutral", "do neither")):
        names = [name for name, value in classes.items() if value == growth]
        if names:
            parts.append(f"{verb} on {', '.join(names)}")
    return "Gradients through time " + "; ".join(parts)


def figure(shown: Arranged) -> Figure | None:
    """Draw a column of panels per problem: gradient norms, singular values, gains and variances; None without data."""
    rows = attempted(shown.rows)
    rows = rows[np.isfinite(rows["gradient_median"])]
    groups = [
        (str(name), part.sort_values("time_horizon"))
        for name, part in rows.groupby(problem_of(shown, rows), sort=False)
    ]
    if not groups:
        return None
    title = headline({name: part["growth"].iloc[-1] for name, part in groups})
    drawing = titled_figure(max(WIDTH, 1.45 * len(groups)), 7.6, title)
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
    """Title a panel with the problem, and with the growth of its Jacobian product over the longest horizon."""
    last = rows.iloc[-1]
    panel.set_title("\n".join(map(plain, name.split(", "))), pad=15)
    text = last["growth"]
    if text in ("exploding", "vanishing"):
        rate = "spectral_rate" if text == "exploding" else "stretch_rate"
        text = f"{text}, {last[rate] / last['dt']:.2g}/s"
    colour = CLASSES.get(last["growth"], "#404040")
    panel.text(0.5, 1.02, text, transform=panel.transAxes, ha="center", va="bottom", color=colour, fontweight="bold")


def _draw_norms(panel: Axes, rows: pd.DataFrame) -> None:
    """Draw the median gradient norm at each horizon, with its band from 5% to 95%."""
    shown = rows[rows["gradient_median"] > 0]
    low, high = shown["gradient_low"], shown["gradient_high"]
    panel.fill_between(shown["time_horizon"], low, high, color="#000000", alpha=0.2, linewidth=0)
    panel.plot(shown["time_horizon"], shown["gradient_median"], **NORM)


def _draw_singular(panel: Axes, rows: pd.DataFrame) -> None:
    """Draw the singular values of dx_N/dx_0 at each horizon, and a line at 1, between growth and decay."""
    values = np.array(rows["singular_values"].to_list(), dtype=float)
    values = np.where(values > ROUNDING * values[:, :1], values, np.nan)
    last = values.shape[1] - 1
    for i in range(last, -1, -1):
        panel.plot(rows["time_horizon"], values[:, i], **SINGULAR[0 if i == 0 else 1 if i == last else 2])
    _unity(panel)


def _draw_gain(panel: Axes, rows: pd.DataFrame) -> None:
    """Draw the gain at the longest horizon against the time from a control (or state) to the end of the rollout."""
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
"""The rows of panels: label and drawing function of each."""


def _decades(panels: Any) -> None:
    """Set one logarithmic scale for a row of panels, with few labels."""
    for panel in panels:
        panel.set_yscale("log")
    for panel in panels:
        log_axis(panel, "y", *panels[0].get_ylim())
