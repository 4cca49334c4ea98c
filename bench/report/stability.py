"""The stability map as files: a heat map per integrator, tables, and the short table that is printed.

Knows no plugin: the theoretical boundary is the column ``stiffness_limit`` of the rows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import FixedLocator, NullLocator
from rich.console import Console
from rich.table import Table

from bench.grid import Experiment
from bench.report.figures import save, styled
from bench.report.page import WIDTH, columns
from bench.report.style import PALETTE, axis_name, plain
from bench.report.tables import escape_markdown
from bench.report.views import axis_value, ran
from bench.store import Columns, write_whole

BLUE, BLACK, RED, GREEN, PINK, ORANGE, SKY, _ = PALETTE
VERDICTS = {
    "ok": ("ok", "#cfe8df", "within 10% of the truth"),
    "inaccurate": ("x", ORANGE, "off by more than 10%"),
    "wrong_sign": ("S", PINK, "wrong sign"),
    "zero": ("0", SKY, "exactly 0 where the truth is not"),
    "diverged": ("D", RED, "state diverged"),
    "nonfinite": ("N", BLACK, "state or gradient not finite"),
    "unresolved": ("?", "#d9d9d9", "truth not resolved"),
    "": ("", "#ffffff", "not run"),
}
"""Of each verdict: what is written into its cells, their colour, and its meaning."""
DARK = ("nonfinite", "diverged")
"""Verdicts whose cells take white letters."""
LOST = ("diverged", "nonfinite")
"""Verdicts on the far side of the measured stability boundary."""
GROWING = 1 + 1e-9
"""Measured growth per step above which a state counts as growing: 1 and rounding."""
ACROSS = 3
"""Most panels beside each other."""


@dataclass(frozen=True, eq=False)
class Panel:
    """The map of one integrator and problem, on the backends that agree on every verdict."""

    integrator: str
    scene: str
    contact: str
    backends: tuple[str, ...]
    rows: pd.DataFrame

    @property
    def title(self) -> str:
        """``bouncing_ball, penalty``; the contact law is left out where there is none."""
        return self.scene if self.contact == "none" else f"{self.scene}, {self.contact}"

    @property
    def measured(self) -> str:
        """``jax, torch; truth: physical``."""
        truth = ", ".join(text for text in self.rows["truth"].unique() if text)
        return ", ".join(self.backends) + (f"; truth: {truth}" if truth else "")

    @property
    def kind(self) -> tuple[str, str, str]:
        """Integrator, scene and law without parameters."""
        return self.integrator, self.scene.partition("[")[0], self.contact.partition("[")[0]

    @cached_property
    def boundary(self) -> pd.DataFrame:
        """By dt: the theoretical ``limit``, and the largest stiffness before the first that is unstable, and that one.

        Unstable is what diverged or was measured to grow.
        ``low`` is 0 where even the softest is lost and ``high`` infinite where none is. ``agrees`` where the limit lies
        between them, widened by one cell of the grid.
        """
        found = {}
        for dt, part in self.rows.dropna(subset=["stiffness", "stiffness_limit"]).groupby("dt"):
            part = part.sort_values("stiffness")
            k, lost = part["stiffness"].to_numpy(), unstable(part).to_numpy()
            first = int(np.argmax(lost)) if lost.any() else len(k)
            padded = np.concatenate([[0.0, 0.0], k, [math.inf, math.inf]])
            limit = float(part["stiffness_limit"].median())
            agrees = padded[first] <= limit <= padded[first + 3]
            found[dt] = {"limit": limit, "low": padded[first + 1], "high": padded[first + 2], "agrees": agrees}
        columns = ["limit", "low", "high", "agrees"]
        return pd.DataFrame([list(row.values()) for row in found.values()], list(found), columns).astype(float)


def unstable(rows: pd.DataFrame) -> pd.Series:
    """Mask of the cells that diverged, or whose state grows however slowly where that was measured."""
    return rows["verdict"].isin(LOST) | (rows["growth_factor"] > GROWING)


def panels(rows: pd.DataFrame) -> list[Panel]:
    """The maps, those of a scene and law together; backends that refused all of a problem are left out, the others merged if alike."""
    found: list[Panel] = []
    for (integrator, scene, contact), part in rows.groupby(["integrator", "scene", "contact"], sort=False):
        groups: list[tuple[pd.DataFrame, list[str]]] = []
        for backend, mine in part.groupby("backend", sort=False):
            mine = mine.drop_duplicates(["dt", "stiffness"], keep="last").sort_values(["dt", "stiffness"])
            if ran(mine).empty:
                continue
            alike = next((g for g in groups if _same(g[0], mine)), None)
            if alike is None:
                groups.append((mine, [str(backend)]))
            else:
                alike[1].append(str(backend))
        found += [Panel(str(integrator), str(scene), str(contact), tuple(names), table) for table, names in groups]
    kinds = list(dict.fromkeys(panel.kind for panel in found))
    return sorted(found, key=lambda panel: kinds.index(panel.kind))


def _same(a: pd.DataFrame, b: pd.DataFrame) -> bool:
    """Whether two maps have the same cells and verdicts."""
    named = ["dt", "stiffness", "verdict", "status"]
    return a[named].reset_index(drop=True).equals(b[named].reset_index(drop=True))


# ---------------------------------------------------------------------------------------------------- files


def write(experiment: Experiment, rows: pd.DataFrame, table: Columns) -> list[Path]:
    """Write ``stability_map`` (.csv, .md) and a heat map per integrator; print the short table."""
    directory = experiment.directory
    maps = panels(rows)
    text = rows.reindex(columns=list(table.names)).to_csv(index=False, lineterminator="\n")
    paths = [directory / "stability_map.csv", directory / "stability_map.md"]
    write_whole(paths[0], text.encode())
    write_whole(paths[1], markdown(experiment, maps).encode())
    with styled():
        for integrator in dict.fromkeys(panel.integrator for panel in maps):
            figure = heat_map(integrator, [panel for panel in maps if panel.integrator == integrator])
            name = "".join(letter if letter.isalnum() else "_" for letter in integrator).strip("_")
            paths += save(figure, directory / f"stability_map_{name}")
    show(experiment, rows, maps)
    return paths


def shares(maps: Sequence[Panel]) -> dict[str, float]:
    """The share of each verdict among the cells of some maps that ran, and of those that are unstable."""
    cells = pd.concat([ran(panel.rows) for panel in maps])
    found = {name: float((cells["verdict"] == name).mean()) for name in VERDICTS if name}
    return found | {"unstable": float(unstable(cells).mean())}


def markdown(experiment: Experiment, maps: Sequence[Panel]) -> str:
    """Every map as a line: shares of the verdicts, and the measured against the theoretical boundary."""
    names = [*(name for name in VERDICTS if name), "unstable"]
    heads = ["integrator", "scene", "contact", "backends", "cells", *names, "dt", "theory", "measured", "agree"]
    out = [f"# {escape_markdown(experiment.name)}: shares of verdicts and stability limits", ""]
    out += ["| " + " | ".join(map(escape_markdown, heads)) + " |", "|" + "---|" * 4 + "--:|" * (len(heads) - 4)]
    for panel in maps:
        cells = [panel.integrator, panel.scene, panel.contact, ", ".join(panel.backends), str(len(ran(panel.rows)))]
        cells += [_percent(share) for share in shares([panel]).values()] + _limits(panel)
        out.append("| " + " | ".join(map(escape_markdown, cells)) + " |")
    out += ["", *(f"- {escape_markdown(note)}" for note in NOTES)]
    return "\n".join(out) + "\n"


NOTES = (
    "ok: " + ", ".join(f"{name}: {VERDICTS[name][2]}" for name in VERDICTS if name).removeprefix("ok: ") + ".",
    "unstable: diverged, or, without contact, a state measured to grow by more than 1e-9 a step: it diverges at a longer "
    "horizon, whatever the verdict on the gradient at this one.",
    "theory: stiffness at which the step's spectral radius on the oscillator leaves 1, at that dt; for a contact, while it "
    "lasts. measured: the largest stiffness before the first that is unstable, and that one.",
    "agree: step sizes at which theory and measurement are within one cell of the grid.",
)


def _percent(share: float) -> str:
    return f"{100 * share:.0f}%" if share else "-"


def _limits(panel: Panel) -> list[str]:
    """The dt told, both boundaries there, and at how many dt they agree."""
    known = panel.boundary
    if known.empty:
        return ["-"] * 4
    inside = (known["low"] > 0) & np.isfinite(known["high"])
    told = known[inside] if inside.any() else known
    dt = told.index[len(told) // 2]
    row = told.loc[dt]
    theory = {0.0: "never stable", math.inf: "always stable"}.get(
        row["limit"], axis_value(float(f"{row['limit']:.3g}"))
    )
    return [axis_value(dt), theory, _between(row["low"], row["high"]), f"{int(known['agrees'].sum())} of {len(known)}"]


def _between(low: float, high: float) -> str:
    if low == 0:
        return f"below {axis_value(high)}"
    return f"above {axis_value(low)}" if math.isinf(high) else f"{axis_value(low)} to {axis_value(high)}"


def show(experiment: Experiment, rows: pd.DataFrame, maps: Sequence[Panel]) -> None:
    """Print the shares of the verdicts, and the boundaries of the oscillators without contact."""
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = max(console.width, 120)
    console.print(f"\n{experiment.name}: {experiment.question}" if experiment.question else f"\n{experiment.name}")
    counts = rows["status"].value_counts()
    console.print(f"{len(rows)} cells: " + ", ".join(f"{n} {status}" for status, n in counts.items()))
    table = _table(["integrator", "scene"], ["cells", *(name for name in VERDICTS if name), "unstable"])
    kinds = list(dict.fromkeys((panel.integrator, panel.scene.partition("[")[0]) for panel in maps))
    for integrator, scene in kinds:
        mine = [p for p in maps if (p.integrator, p.scene.partition("[")[0]) == (integrator, scene)]
        cells = [str(sum(len(ran(panel.rows)) for panel in mine)), *map(_percent, shares(mine).values())]
        table.add_row(integrator, scene, *cells)
    console.print(table)
    limits = _table(["integrator", "oscillator"], ["dt", "theory", "measured", "dt that agree"])
    for panel in maps:
        if panel.contact == "none" and not panel.boundary.empty:
            limits.add_row(panel.integrator, panel.scene, *_limits(panel))
    if limits.row_count:
        console.print(
            "\nStability limit as a stiffness: where the spectral radius leaves 1, and where states grow or diverge."
        )
        console.print(limits)
    reasons = rows[rows["status"].isin(("unsupported", "unavailable", "error"))].groupby(["status", "reason"]).size()
    for (status, reason), count in reasons.items():
        console.print(f"{count} {status}: {reason}")


def _table(left: Sequence[str], right: Sequence[str]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="underline")
    for name in left:
        table.add_column(name, overflow="fold")
    for name in right:
        table.add_column(name, justify="right")
    return table


# --------------------------------------------------------------------------------------------------- charts


def heat_map(integrator: str, maps: Sequence[Panel]) -> Figure:
    """Verdicts of one integrator over dt and stiffness, one panel a problem, with the theoretical boundary."""
    across = columns(len(maps), ACROSS)
    down = math.ceil(len(maps) / across)
    rows = pd.concat([panel.rows for panel in maps])
    steps, levels = (np.sort(rows[name].dropna().unique()) for name in ("dt", "stiffness"))
    width = WIDTH if across > 2 else 0.5 * WIDTH * across
    figure = Figure(figsize=(width, 0.75 + down * (0.75 + 0.22 * max(len(levels), 4)) + 0.3), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(down, across, squeeze=False)
    measured = {panel.measured for panel in maps}
    common = len(measured) == 1
    head = f"Is the gradient right? {plain(integrator)}" + "".join(f" on {text}" for text in measured if common)
    figure.suptitle(head, fontsize=9, fontweight="bold")
    for axes, panel in zip(grid.flat, maps, strict=False):
        _draw(axes, panel, steps, levels, common)
    for spare in grid.flat[len(maps) :]:
        spare.remove()
    for i, axes in enumerate(grid.flat[: len(maps)]):
        if i % across:
            axes.set_yticklabels([])
        else:
            axes.set_ylabel(axis_name("stiffness"))
        if i + across >= len(maps):
            axes.set_xlabel(axis_name("dt"))
        else:
            axes.set_xticklabels([])
    present = [name for name in VERDICTS if name in set(rows["verdict"])]
    legend: list[Any] = [_swatch(name) for name in present]
    if (unstable(rows) & ~rows["verdict"].isin(LOST)).any():
        legend.append(Patch(label="striped: state grows, slowly", facecolor="white", **STRIPES))
    if any(axes.lines for axes in grid.flat[: len(maps)]):
        legend.append(Line2D([], [], **BOUNDARY, label="theory: spectral radius 1"))
    figure.legend(handles=legend, loc="outside lower center", ncols=min(3, len(legend)), columnspacing=1.2)
    return figure


STRIPES: dict[str, Any] = {"hatch": "////", "edgecolor": "#9a9a9a", "linewidth": 0.0}
HALO = [patheffects.withStroke(linewidth=3, foreground="white")]
BOUNDARY: dict[str, Any] = {"color": BLUE, "linewidth": 1.3, "linestyle": (0, (4, 1.5)), "path_effects": HALO}


def _swatch(name: str) -> Patch:
    letter, colour, meaning = VERDICTS[name]
    label = meaning if letter in ("", "ok") else f"{letter}: {meaning}"
    return Patch(facecolor=colour, edgecolor="#808080", linewidth=0.4, label=label)


def _draw(axes: Axes, panel: Panel, steps: np.ndarray, levels: np.ndarray, common: bool) -> None:
    """Cells with their letters, and the boundary."""
    x, y = _edges(steps), _edges(levels)
    whole = panel.rows["stiffness"].isna().all()
    heights = np.array([y[0], y[-1]]) if whole else y
    names = list(VERDICTS)
    codes = np.full((len(heights) - 1, len(steps)), names.index(""))
    for row in panel.rows.to_dict("records"):
        column = int(np.searchsorted(steps, row["dt"]))
        line = 0 if whole else int(np.searchsorted(levels, row["stiffness"]))
        codes[line, column] = names.index(row["verdict"] if row["verdict"] in VERDICTS else "")
        colour = "white" if row["verdict"] in DARK else "black"
        middle = math.sqrt(heights[line] * heights[line + 1])
        letter, fill, _ = VERDICTS[names[codes[line, column]]]
        halo = [patheffects.withStroke(linewidth=2.5, foreground=fill)]
        axes.text(steps[column], middle, letter, color=colour, path_effects=halo, **LETTER)
    colours = ListedColormap([colour for _, colour, _ in VERDICTS.values()])
    axes.pcolormesh(
        x, heights, codes, cmap=colours, vmin=-0.5, vmax=len(names) - 0.5, edgecolors="white", linewidth=0.4
    )
    for row in panel.rows[unstable(panel.rows) & ~panel.rows["verdict"].isin(LOST)].to_dict("records"):
        i, j = int(np.searchsorted(steps, row["dt"])), int(np.searchsorted(levels, row["stiffness"]))
        axes.add_patch(Rectangle((x[i], y[j]), x[i + 1] - x[i], y[j + 1] - y[j], fill=False, zorder=2, **STRIPES))
    axes.set(xscale="log", yscale="log", xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    axes.xaxis.set_major_locator(FixedLocator(list(steps[:: -1 if len(steps) <= 4 else -2])))
    axes.xaxis.set_major_formatter(lambda value, _: axis_value(float(f"{value:.3g}")))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_title("\n".join(_title(panel, whole, common)), pad=4)
    _draw_boundary(axes, panel, x)


LETTER: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 6.5, "zorder": 5}


def _title(panel: Panel, whole: bool, common: bool) -> list[str]:
    """The problem, how it was measured unless that is common to all panels, and what the boundary is where it is no line."""
    lines = [plain(panel.scene), plain(panel.contact) if panel.contact != "none" else "no contact"]
    limits = set(panel.boundary["limit"])
    theory = {"": limits - {0.0, math.inf} or not limits, "never stable": limits == {0.0}, "always stable": True}
    note = next(text for text, holds in theory.items() if holds)
    parts = ["theory: " + note if note else "", "has no stiffness" if whole else ""]
    return [*lines, *filter(None, ["" if common else panel.measured, "; ".join(filter(None, parts))])]


def _draw_boundary(axes: Axes, panel: Panel, x: np.ndarray) -> None:
    """The limit along dt, carried on to the edges of the panel."""
    limit = panel.boundary["limit"]
    limit = limit[(limit > 0) & np.isfinite(limit)]
    if len(limit) < 2:
        return
    dt, k = np.log(limit.index.to_numpy(dtype=float)), np.log(limit.to_numpy())
    ends = np.log([x[0], x[-1]])
    slopes = (k[1] - k[0]) / (dt[1] - dt[0]), (k[-1] - k[-2]) / (dt[-1] - dt[-2])
    values = [k[0] + slopes[0] * (ends[0] - dt[0]), *k, k[-1] + slopes[1] * (ends[1] - dt[-1])]
    axes.plot(np.exp([ends[0], *dt, ends[1]]), np.exp(values), **BOUNDARY)


def _edges(values: np.ndarray) -> np.ndarray:
    """Edges of cells around values on a log axis."""
    if len(values) == 0:
        return np.array([1.0, 10.0])
    logs = np.log(values)
    if len(logs) == 1:
        return np.asarray(np.exp(logs[0] + np.array([-0.5, 0.5])))
    inner = 0.5 * (logs[1:] + logs[:-1])
    return np.asarray(np.exp([1.5 * logs[0] - 0.5 * logs[1], *inner, 1.5 * logs[-1] - 0.5 * logs[-2]]))
