"""Writes the files of a trace: the table of one rollout, and a chart with a shared time axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator

from bench.report.draw import WIDTH
from bench.report.figures import save, styled
from bench.report.scales import log_axis
from bench.report.style import GREY, PALETTE, SHADE, STYLE, filled, plain
from bench.run.files import make_directory, write_whole
from bench.trace.contacts import TOUCHES
from bench.trace.sentences import three_digits
from bench.trace.spikes import MEASURES, align, spikes
from bench.trace.trace import Trace

PANEL = 1.05
"""Height of a panel in inches."""
BLUE, BLACK, RED, GREEN, PINK = PALETTE[:5]
SLIPPING: dict[str, Any] = {"color": "#a6a6a6", "alpha": 0.6, "linewidth": 0}
SWITCH: dict[str, Any] = {"color": GREY, "linewidth": 0.5}
SPIKED: dict[str, Any] = {"color": RED, "linewidth": 2.4, "solid_capstyle": "butt"}
DRAWN = 1e30
"""Magnitude beyond which a diverging quantity is omitted from its panel, but not from the table."""
LINEAR = 1e4
"""Ratio of the largest to the median magnitude beyond which a panel's scale is not linear."""
NAMES = {
    "jacobian_norm": r"$\|\partial x_{k+1} / \partial x_k\|$",
    "adjoint_norm": r"$\|\mathrm{d}L / \mathrm{d}x_k\|$",
}


def write(trace: Trace, results_dir: Path, formats: Sequence[str] = ("png",)) -> list[Path]:
    """Write ``trace.csv``, which has the plotted data, and the chart in the given formats; return their paths.

    The directory is ``results_dir/trace/<scene>``. Raises :class:`StorageError` if a file cannot be written.
    """
    directory = results_dir / "trace" / trace.scene
    make_directory(directory)
    paths = [directory / "trace.csv"]
    write_whole(paths[0], trace.table.to_csv(index=False).encode())
    with styled():
        paths += save(chart(trace), directory / "trace", formats)
    return paths


def chart(trace: Trace) -> Figure:
    """Return a figure of gap (or positions), force, |dF/dx|, |dL/dx| and cost against time.

    Several contacts have a panel with a row each, in which a bar shows where the contact acts. Contact switches are thin
    vertical lines through all panels, states in contact are shaded, and spikes are thick and red.
    """
    table = trace.table
    contact = bool(table["gap"].notna().any())
    drawn = [_gap, *([_rows] if _names(table) else []), _force] if contact else [_positions]
    figure = Figure(figsize=(WIDTH, PANEL * (len(drawn) + 3) + 1.0), layout="constrained")
    axes: Sequence[Axes] = figure.subplots(len(drawn) + 3, 1, sharex=True)
    norms: list[Any] = [partial(_norm, name=name) for name in NAMES]
    for panel, ax in zip([*drawn, *norms, _cost], axes, strict=True):
        _contacts(ax, table)
        panel(ax, table)
        ax.margins(x=0.01)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels()
    figure.suptitle(filled(plain(trace.title), WIDTH - 0.3), fontsize=STYLE["font.size"])
    handles = _legend(table)
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _legend(table: pd.DataFrame) -> list[Any]:
    handles: list[Any] = []
    if table["contacts"].any():
        handles.append(Patch(label="in contact", **SHADE))
    if (table["slipping"] > 0).any():
        handles.append(Patch(label="slipping", **SLIPPING))
    if table["switch"].any():
        handles.append(Line2D([], [], label="contact switch", **SWITCH))
    if any(spikes(table[name]).any() for name in MEASURES):
        handles.append(Line2D([], [], label="spike: the largest changes over a step", **SPIKED))
    return handles


def _contacts(ax: Axes, table: pd.DataFrame) -> None:
    """Shade the states in contact, darker where a contact slips, and mark each switch between its two states."""
    time = table["time"].to_numpy()
    half = 0.5 * (time[1] - time[0])
    for name, look in (("contacts", SHADE), ("slipping", SLIPPING)):
        for start, end in _runs(table[name]):
            ax.axvspan(time[start] - half, time[end - 1] + half, **look)
    for k in np.flatnonzero(table["switch"]):
        ax.axvline(time[k] - half, **SWITCH)


def _runs(values: pd.Series) -> Iterator[tuple[int, int]]:
    """Return first and last place, exclusive, of each run of positive values."""
    edges = np.diff(np.concatenate([[0], values > 0, [0]]))
    return zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True)


def _gap(ax: Axes, table: pd.DataFrame) -> None:
    factor, unit = (1e3, "mm") if table["gap"].abs().max() < 0.1 else (1.0, "m")
    ax.axhline(0.0, color=GREY, linewidth=0.6, linestyle=(0, (4, 3)))
    _line(ax, table, factor * table["gap"], BLUE)
    ax.set_ylabel(f"gap [{unit}]")


def _names(table: pd.DataFrame) -> list[str]:
    """Return the columns of the contacts that act somewhere, or all of them if none does."""
    every = [str(name) for name in table if str(name).startswith(TOUCHES)]
    return [name for name in every if table[name].any()] or every


def _rows(ax: Axes, table: pd.DataFrame) -> None:
    """Draw a row per contact, with a bar over the states in which it acts."""
    time, names = table["time"].to_numpy(), _names(table)
    half = 0.5 * (time[1] - time[0])
    for row, name in enumerate(names):
        bars = [(time[start] - half, time[end - 1] - time[start] + 2 * half) for start, end in _runs(table[name])]
        ax.broken_barh(bars, (row - 0.3, 0.6), color=BLUE, linewidth=0)
    ax.set_yticks(range(len(names)), [plain(name.removeprefix(TOUCHES)) for name in names])
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.set_ylabel("in contact")


def _force(ax: Axes, table: pd.DataFrame) -> None:
    _line(ax, table, table["force"], GREEN)
    peak = table["force"].max()
    if peak > 0:
        _note(ax, f"peak {three_digits(peak)} N")
    ax.set_ylabel("force [N]")


def _positions(ax: Axes, table: pd.DataFrame) -> None:
    names = [name for name in table if str(name)[0] in "qv" and str(name)[1:].isdigit()]
    shown = [name for name in names if str(name)[0] == "q"] or names
    for index, name in enumerate(shown):
        label = f"${str(name)[0]}_{{{str(name)[1:]}}}$"
        _line(ax, table, table[name], PALETTE[index % len(PALETTE)], label=label)
    if len(shown) > 1:
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.2)
    ax.set_ylabel("position" if shown != names or not len(names) else "state")


def _norm(ax: Axes, table: pd.DataFrame, name: str) -> None:
    values = table[name].where((table[name] > 1 / DRAWN) & (table[name] < DRAWN))
    _line(ax, table, values, BLUE if name == "jacobian_norm" else BLACK)
    time = table["time"].to_numpy()
    for k in np.flatnonzero(spikes(table[name])):
        ax.plot(time[k : k + 2], values.to_numpy()[k : k + 2], **SPIKED)
    if values.notna().any():
        low, high = float(values.min()), float(values.max())
        middle = np.sqrt(low * high)  # at least a decade is shown around it
        log_axis(ax, "y", min(low / 1.3, middle / 3.2), max(high * 1.6, middle * 3.2))
    alignment = align(table[name], table["switch"])
    if alignment.spikes and table["switch"].any():
        _note(
            ax,
            f"{alignment.near} of {alignment.spikes} spikes at a switch, {100 * alignment.chance:.0f}% by chance, p = {alignment.p_value:.1g}",
        )
    ax.set_ylabel(NAMES[name])


def _cost(ax: Axes, table: pd.DataFrame) -> None:
    stage, terminal = table["cost_stage"], table["cost_terminal"]
    end = float(terminal.iloc[-1])
    parts = [f"terminal {three_digits(end)} (dot)"]
    if (stage.fillna(0.0) != 0).any():
        _line(ax, table, stage, PINK)
        parts.append(f"stages {three_digits(float(stage.sum()))} in all (line)")
    elif 0.0 < abs(end) < DRAWN:
        ax.set_ylim(min(0.0, 1.3 * end), max(0.0, 1.3 * end))
        ax.yaxis.set_major_locator(MaxNLocator(nbins=3))
    terminal = terminal.where(terminal.abs() < DRAWN)
    ax.plot(table["time"], terminal, marker="o", color=BLACK, linestyle="none", clip_on=False)
    _note(ax, ", ".join(parts))
    ax.set_ylabel("cost")


def _line(ax: Axes, table: pd.DataFrame, values: pd.Series, colour: str, **look: Any) -> None:
    """Draw a quantity against time, with a dot for each state if there is space for dots."""
    few = len(table) <= 80
    values = values.where(values.abs() < DRAWN)
    finite = values[np.isfinite(values)].abs()
    ax.plot(table["time"], values, color=colour, marker="." if few else "", markersize=3, **look)
    if len(finite) and finite.max() > LINEAR * max(float(finite.median()), 1e-300) and finite.max() > 1e6:
        ax.set_yscale("symlog", linthresh=max(float(finite.median()), 1e-12))
    elif ax.get_yscale() == "linear":
        ax.yaxis.set_major_locator(MaxNLocator(nbins=3))
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.6g}"))


def _note(ax: Axes, text: str) -> None:
    """Write a remark above the panel's right corner."""
    size = STYLE["font.size"] - 1
    ax.text(0.99, 1.0, text, transform=ax.transAxes, ha="right", va="bottom", color=GREY, fontsize=size)
