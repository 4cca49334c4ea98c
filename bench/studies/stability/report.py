"""Writes the stability map: a heat map per integrator, tables, and a short table on the terminal.

It needs no plugin, because the theoretical boundary is stored in the column ``stiffness_limit``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import FixedLocator, NullLocator

from bench.experiment.axes import Axis
from bench.experiment.columns import COMMON
from bench.experiment.experiment import Experiment
from bench.experiment.parameters import parse
from bench.report.figures import save, styled
from bench.report.page import WIDTH, columns
from bench.report.problems import axes_of, part_columns, problem_names, problem_numbers, value_text
from bench.report.study_tables import open_console, print_table, titled_figure, write_tables
from bench.report.style import PALETTE, axis_name, plain
from bench.report.tables import escape_markdown, plain_markdown
from bench.report.text import axis_value
from bench.report.views import Arranged, arrange, attempted
from bench.report.web.content import distinguishing_columns

BLUE, BLACK, RED, GREEN, PINK, ORANGE, SKY, _ = PALETTE
VERDICTS = {
    "ok": ("ok", "#cfe8df", "within {inaccurate} of the truth"),
    "inaccurate": ("x", ORANGE, "off by more than {inaccurate}"),
    "wrong_sign": ("S", PINK, "wrong sign"),
    "zero": ("0", SKY, "exactly 0 where the truth is not"),
    "diverged": ("D", RED, "state diverged"),
    "nonfinite": ("N", BLACK, "state or gradient not finite"),
    "unresolved": ("?", "#d9d9d9", "truth not resolved"),
    "": ("", "#ffffff", "not run"),
}
"""Per verdict: the character in its cells, the cells' colour, and the meaning, with placeholders for the study's limits."""
DARK = ("nonfinite", "diverged")
"""Verdicts whose cells have white characters."""
WRONG = ("inaccurate", "wrong_sign", "zero")
"""Verdicts of finite but wrong gradients, which are coloured by cause."""
CAUSES = {
    "step": (ORANGE, "wrong because of the step or its derivative, the law is right"),
    "law": (SKY, "wrong because of the law, at any step"),
    "both": (PINK, "wrong because of step and law"),
    "unknown": ("#a39bc8", "?: wrong, the cause is not resolved"),
    "": ("#c9b458", "wrong, the cause was not recorded"),
}
"""Colour and meaning of each cause of a finite but wrong gradient."""
FILLS = {
    "ok": VERDICTS["ok"][1],
    **{f"by {cause}": fill for cause, (fill, _) in CAUSES.items()},
    **{name: fill for name, (_, fill, _) in VERDICTS.items() if name not in ("ok", *WRONG)},
}
"""Colours of cells and bars, by the keys that :func:`looks` returns."""
LOST = ("diverged", "nonfinite")
"""Verdicts of cells whose state or gradient is lost: they count as unstable."""
GROWING = 1 + 1e-9
"""Measured growth per step above which a state counts as growing: 1 plus rounding."""
ACROSS = 3
"""Most panels side by side."""


PLACES = ("dt", "stiffness")
"""The axes of a map."""
STEP = ("scene", "contact", "integrator")


@dataclass(frozen=True, eq=False)
class Panel:
    """The map of one integrator and problem, on the backends that agree in every verdict."""

    integrator: str
    """Identity string of the integrator; the next two are the identity strings of the scene and the contact law."""
    scene: str
    contact: str
    values: Mapping[str, str]
    """Values, as strings, of the columns that distinguish the map from other maps: :func:`label_columns_of`."""
    kind: tuple[str, ...]
    """Names of integrator, scene and law, without parameters."""
    backends: tuple[str, ...]
    rows: pd.DataFrame

    @property
    def title(self) -> str:
        """The problem: ``bouncing_ball, penalty, damping=0``."""
        values = (f"{name}={value}" for name, value in self.values.items() if value != "-")
        return ", ".join([self.scene, *([] if self.contact == "none" else [self.contact]), *values])

    @property
    def measured(self) -> str:
        """The backends and the kind of truth: ``jax, torch; truth: physical``."""
        truth = ", ".join(text for text in self.rows["truth"].unique() if text)
        return ", ".join(self.backends) + (f"; truth: {truth}" if truth else "")

    @cached_property
    def boundary(self) -> pd.DataFrame:
        """The stability limit by dt: ``limit`` in theory, ``low`` and ``high`` as measured, and ``agrees``.

        ``high`` is the lowest unstable stiffness of the grid (infinite without one), and ``low`` the next lower
        stiffness (0 without one). A cell is unstable if it diverged or its state was measured to grow. ``agrees`` is 1
        where the limit lies in the interval widened by one cell of the grid, else 0.
        """
        limits = {}
        for dt, part in self.rows.dropna(subset=["stiffness", "stiffness_limit"]).groupby("dt"):
            part = part.sort_values("stiffness")
            k, lost = part["stiffness"].to_numpy(), unstable(part).to_numpy()
            first = int(np.argmax(lost)) if lost.any() else len(k)
            padded = np.concatenate([[0.0, 0.0], k, [math.inf, math.inf]])
            limit = float(part["stiffness_limit"].median())
            agrees = padded[first] <= limit <= padded[first + 3]
            limits[dt] = {"limit": limit, "low": padded[first + 1], "high": padded[first + 2], "agrees": agrees}
        columns = ["limit", "low", "high", "agrees"]
        return pd.DataFrame([list(row.values()) for row in limits.values()], list(limits), columns).astype(float)


def unstable(rows: pd.DataFrame) -> pd.Series:
    """Return a mask of the unstable cells: diverged, not finite, or with a state that was measured to grow."""
    return rows["verdict"].isin(LOST) | (rows["growth_factor"] > GROWING)


def with_verdict(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of cells that have a verdict."""
    rows = attempted(rows)
    return rows[rows["verdict"] != ""]


def looks(rows: pd.DataFrame) -> pd.Series:
    """Return the key of each cell's colour in :data:`FILLS`: its verdict, or the cause of a finite but wrong gradient."""
    verdict = rows["verdict"].where(rows["verdict"].isin(list(VERDICTS)), "")
    return verdict.where(~verdict.isin(WRONG), "by " + rows["cause"].where(rows["cause"].isin(list(CAUSES)), ""))


def colour_legend(rows: pd.DataFrame) -> list[Patch]:
    """Return legend handles for the colours that occur in the rows."""
    present = set(looks(rows))
    named = {name: f"{VERDICTS[name][0]}: {meaning(name, rows)}" for name in VERDICTS if name not in (*WRONG, "", "ok")}
    named |= {"ok": meaning("ok", rows), "": VERDICTS[""][2]}
    named |= {f"by {cause}": text for cause, (_, text) in CAUSES.items()}
    return [
        Patch(facecolor=FILLS[name], edgecolor="#808080", linewidth=0.4, label=named[name])
        for name in FILLS
        if name in present
    ]


def arrange_maps(experiment: Experiment, rows: pd.DataFrame) -> Arranged:
    """Arrange rows for reading, with each cell's stored step size and stiffness; the cause is empty in older rows."""
    shown = arrange(experiment, rows)
    cause = rows["cause"].fillna("") if "cause" in rows else ""
    return replace(shown, rows=shown.rows.assign(**{name: rows[name] for name in PLACES}, cause=cause))


def panels(shown: Arranged) -> list[Panel]:
    """Return the maps, grouped by integrator, scene and law.

    A map has all rows with equal parameters of scene, contact law and integrator, except step size and stiffness.
    Backends with equal maps share one map, and backends that support no cell of a map are omitted.
    """
    over = axes_of(shown, *PLACES)
    rows = shown.rows.assign(
        map=problem_numbers(shown.rows, STEP, over),
        kind=[
            tuple(name_of(given.get(part)) for part in ("integrator", "scene", "contact"))
            for given in parse(shown.rows)
        ],
        machine=problem_names(shown, ["backend"], always=["backend"]),
    )
    labels = label_columns_of(shown, over)
    maps: list[Panel] = []
    for _, part in rows.groupby("map", sort=False):
        groups: list[tuple[pd.DataFrame, list[str]]] = []
        for backend, cells in part.groupby("machine", sort=False):
            cells = cells.drop_duplicates(list(PLACES), keep="last").sort_values(list(PLACES))
            if attempted(cells).empty:
                continue
            equal = next((group for group in groups if _have_equal_verdicts(group[0], cells)), None)
            if equal is None:
                groups.append((cells, [str(backend)]))
            else:
                equal[1].append(str(backend))
        first = part.iloc[0]
        integrator, scene, contact = (str(first[name]) for name in ("integrator", "scene", "contact"))
        values = {name: value_text(first[name]) for name in labels}
        maps += [
            Panel(integrator, scene, contact, values, first["kind"], tuple(names), table) for table, names in groups
        ]
    kinds = list(dict.fromkeys(panel.kind for panel in maps))
    return sorted(maps, key=lambda panel: kinds.index(panel.kind))


def label_columns_of(shown: Arranged, over: Sequence[Axis]) -> list[str]:
    """Return the columns, besides integrator, scene and law, that distinguish the maps."""
    basic = ("integrator", "scene", "contact")
    names = [*basic, *(name for name in part_columns(shown, STEP, over) if name not in (*basic, *PLACES, "horizon"))]
    return [
        name
        for name in distinguishing_columns(shown.rows, problem_numbers(shown.rows, STEP, over), names, basic)
        if name not in basic
    ]


def name_of(part: Any) -> str:
    """Return the name of a plugin given by its parameters in a row; ``none`` for no plugin."""
    return "none" if part is None else str(part["name"])


def limits(rows: pd.DataFrame) -> dict[str, str]:
    """Return the studies' limits as strings: ``{"inaccurate": "10%"}``, or ``10% or 20%`` if the rows' studies differ."""
    texts = dict.fromkeys(given["study"]["inaccurate"] for given in parse(rows) if given)
    return {"inaccurate": " or ".join(f"{100 * limit:g}%" for limit in texts)}


def meaning(verdict: str, rows: pd.DataFrame) -> str:
    """Return the meaning of a verdict, with the limits of the rows' studies."""
    return VERDICTS[verdict][2].format(**limits(rows))


def _have_equal_verdicts(a: pd.DataFrame, b: pd.DataFrame) -> bool:
    """Return whether two maps have the same cells and verdicts."""
    names = ["dt", "stiffness", "verdict", "cause", "status"]
    return bool(a[names].reset_index(drop=True).equals(b[names].reset_index(drop=True)))


# ---------------------------------------------------------------------------------------------------- files


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``stability_map`` (.csv, .md) and a heat map per integrator."""
    shown = arrange_maps(experiment, rows)
    maps = panels(shown)
    paths = write_tables(experiment, rows, "stability_map", [markdown(shown, maps)])
    with styled():
        for integrator in dict.fromkeys(panel.integrator for panel in maps):
            figure = heat_map(integrator, [panel for panel in maps if panel.integrator == integrator], shown.axes)
            name = "".join(character if character.isalnum() else "_" for character in integrator).strip("_")
            paths += save(figure, experiment.directory / f"stability_map_{name}", experiment.formats)
    return paths


def shares(maps: Sequence[Panel]) -> dict[str, float]:
    """Return each verdict's share of the cells that ran in some maps, and the share of unstable cells."""
    cells = pd.concat([attempted(panel.rows) for panel in maps])
    by_verdict = {name: float((cells["verdict"] == name).mean()) for name in VERDICTS if name}
    return by_verdict | {"unstable": float(unstable(cells).mean())}


def markdown(shown: Arranged, maps: Sequence[Panel]) -> str:
    """Return the report as Markdown: a line per map with shares of the verdicts and both stability limits, and notes."""
    labels = ["integrator", "scene", "contact", *label_columns_of(shown, axes_of(shown, *PLACES)), "backends"]
    results = ["cells", *(name for name in VERDICTS if name), "unstable", "dt", "theory", "measured", "agree"]
    lines = []
    for panel in maps:
        names = [panel.integrator, panel.scene, panel.contact, *panel.values.values(), ", ".join(panel.backends)]
        percentages = map(_percent, shares([panel]).values())
        lines.append([*names, str(len(attempted(panel.rows))), *percentages, *_limits(panel)])
    heads = list(map(escape_markdown, [*labels, *results]))
    out = [f"# {escape_markdown(shown.experiment.name)}: shares of verdicts and stability limits", ""]
    out += [plain_markdown(pd.DataFrame(lines, columns=heads)), ""]
    return "\n".join([*out, *(f"- {escape_markdown(note)}" for note in notes(shown.rows))])


def notes(rows: pd.DataFrame) -> list[str]:
    """Return explanations of the table's columns, with the limits of the rows' studies."""
    return [
        "ok: " + ", ".join(f"{n}: {meaning(n, rows)}" for n in VERDICTS if n).removeprefix("ok: ") + ".",
        "unstable: diverged, or, without contact, a state that grows by more than 1e-9 per step and would diverge at a longer "
        "horizon, whatever the verdict on the gradient at this one.",
        "theory: stiffness at which the step's spectral radius on the oscillator exceeds 1, at that dt. A contact is an "
        "oscillator while it lasts. measured: the largest stiffness below the first unstable one, and that one.",
        "agree: step sizes at which theory and measurement are within one cell of the grid.",
    ]


def _percent(share: float) -> str:
    return f"{100 * share:.0f}%" if share else "-"


def _limits(panel: Panel) -> list[str]:
    """Format a dt, the theoretical and measured stability limits at that dt, and the number of dt at which they agree."""
    limits = panel.boundary
    if limits.empty:
        return ["-"] * 4
    inside = (limits["low"] > 0) & np.isfinite(limits["high"])
    chosen = limits[inside] if inside.any() else limits
    dt = chosen.index[len(chosen) // 2]
    row = chosen.loc[dt]
    theory = {0.0: "never stable", math.inf: "always stable"}.get(
        row["limit"], axis_value(float(f"{row['limit']:.3g}"))
    )
    return [
        axis_value(dt),
        theory,
        _between(row["low"], row["high"]),
        f"{int(limits['agrees'].sum())} of {len(limits)}",
    ]


def _between(low: float, high: float) -> str:
    if low == 0:
        return f"below {axis_value(high)}"
    return f"above {axis_value(low)}" if math.isinf(high) else f"{axis_value(low)} to {axis_value(high)}"


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the shares of the verdicts, and the stability limits of the oscillators without contact."""
    maps = panels(arrange_maps(experiment, rows))
    console = open_console(experiment, rows)
    lines = []
    for kind in dict.fromkeys(panel.kind[:2] for panel in maps):
        members = [panel for panel in maps if panel.kind[:2] == kind]
        n_cells = sum(len(attempted(panel.rows)) for panel in members)
        lines.append([*kind, str(n_cells), *map(_percent, shares(members).values())])
    results = ["cells", *(name for name in VERDICTS if name), "unstable"]
    print_table(console, pd.DataFrame(lines, columns=["integrator", "scene", *results]), right=results)
    oscillators = [panel for panel in maps if panel.contact == "none" and not panel.boundary.empty]
    if oscillators:
        results = ["dt", "theory", "measured", "dt that agree"]
        lines = [[panel.integrator, panel.title, *_limits(panel)] for panel in oscillators]
        console.print(
            "\nStability limit as a stiffness: spectral radius 1 in theory, growth or divergence as measured."
        )
        print_table(console, pd.DataFrame(lines, columns=["integrator", "oscillator", *results]), right=results)
    reasons = rows[rows["status"].isin(("unsupported", "unavailable", "error"))].groupby(["status", "reason"]).size()
    for (status, reason), count in reasons.items():
        console.print(f"{count} {status}: {reason}")


# --------------------------------------------------------------------------------------------------- charts


def heat_map(integrator: str, maps: Sequence[Panel], axes: Sequence[Axis] = ()) -> Figure:
    """Draw one integrator's verdicts over dt and stiffness, one panel per problem, with the theoretical stability limit."""
    across = columns(len(maps), ACROSS)
    down = math.ceil(len(maps) / across)
    rows = pd.concat([panel.rows for panel in maps])
    steps, levels = (np.sort(rows[name].dropna().unique()) for name in ("dt", "stiffness"))
    width = WIDTH if across > 2 else 0.5 * WIDTH * across
    measured = {panel.measured for panel in maps}
    common = len(measured) == 1
    where = "".join(f" ({text})" for text in measured if common)
    cells = with_verdict(rows)
    share = f"right in {(looks(cells) == 'ok').mean():.0%} of the cells" if len(cells) else "not known in any cell"
    title = f"{plain(integrator)}: the gradient is {share}{where}"
    figure = titled_figure(width, 0.75 + down * (0.75 + 0.22 * max(len(levels), 4)) + 0.3, title)
    grid = figure.subplots(down, across, squeeze=False)
    for area, panel in zip(grid.flat, maps, strict=False):
        _draw(area, panel, steps, levels, common)
    for spare in grid.flat[len(maps) :]:
        spare.remove()
    axis_names = {column: _axis_name(column, axes) for column in PLACES}
    for i, area in enumerate(grid.flat[: len(maps)]):
        if i % across:
            area.set_yticklabels([])
        else:
            area.set_ylabel(axis_names["stiffness"])
        if i + across >= len(maps):
            area.set_xlabel(axis_names["dt"])
        else:
            area.set_xticklabels([])
    legend: list[Any] = colour_legend(rows)
    meanings = [f"{VERDICTS[name][0]}: {meaning(name, rows)}" for name in WRONG if name in set(rows["verdict"])]
    legend += [Patch(facecolor="none", label=text) for text in meanings]
    if (unstable(rows) & ~rows["verdict"].isin(LOST)).any():
        legend.append(Patch(label="striped: state grows, slowly", facecolor="white", **STRIPES))
    if any(area.lines for area in grid.flat[: len(maps)]):
        legend.append(Line2D([], [], **BOUNDARY, label="theory: spectral radius 1"))
    figure.legend(handles=legend, loc="outside lower center", ncols=min(2, len(legend)), columnspacing=1.2)
    return figure


STRIPES: dict[str, Any] = {"hatch": "////", "edgecolor": "#9a9a9a", "linewidth": 0.0}
HALO = [patheffects.withStroke(linewidth=3, foreground="white")]
BOUNDARY: dict[str, Any] = {"color": BLUE, "linewidth": 1.3, "linestyle": (0, (4, 1.5)), "path_effects": HALO}


def _axis_name(column: str, axes: Sequence[Axis]) -> str:
    """Return the name and unit of an axis of the maps, without the axes that step with it."""
    axis = next((axis for axis in axes if axis.column == column), Axis(column, (), COMMON[column].unit))
    return axis_name(replace(axis, moves=()))


def _draw(axes: Axes, panel: Panel, steps: np.ndarray, levels: np.ndarray, common: bool) -> None:
    """Draw a map's cells with their colours and characters, and the theoretical stability limit."""
    x, y = _edges(steps), _edges(levels)
    whole = panel.rows["stiffness"].isna().all()
    heights = np.array([y[0], y[-1]]) if whole else y
    names = list(FILLS)
    codes = np.full((len(heights) - 1, len(steps)), names.index(""))
    for row in panel.rows.assign(look=looks(panel.rows)).to_dict("records"):
        column = int(np.searchsorted(steps, row["dt"]))
        line = 0 if whole else int(np.searchsorted(levels, row["stiffness"]))
        codes[line, column] = names.index(row["look"])
        colour = "white" if row["verdict"] in DARK else "black"
        middle = math.sqrt(heights[line] * heights[line + 1])
        letter = VERDICTS.get(row["verdict"], VERDICTS[""])[0]
        halo = [patheffects.withStroke(linewidth=2.5, foreground=FILLS[row["look"]])]
        axes.text(steps[column], middle, letter, color=colour, path_effects=halo, **LETTER)
    colours = ListedColormap(list(FILLS.values()))
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
    """Return a panel's title lines: the problem, backends and truth unless common to all panels, and notes on its limit."""
    lines = list(map(plain, panel.title.split(", ")))
    lines[1:1] = ["no contact"] if panel.contact == "none" else []
    limits = set(panel.boundary["limit"])
    theory = {"": limits - {0.0, math.inf} or not limits, "never stable": limits == {0.0}, "always stable": True}
    note = next(text for text, holds in theory.items() if holds)
    parts = ["theory: " + note if note else "", "has no stiffness" if whole else ""]
    return [*lines, *filter(None, ["" if common else panel.measured, "; ".join(filter(None, parts))])]


def _draw_boundary(axes: Axes, panel: Panel, x: np.ndarray) -> None:
    """Draw the theoretical limit along dt, extrapolated to the edges of the panel."""
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
    """Return the edges ``(n + 1,)`` of cells around ``n`` values on a log axis."""
    if len(values) == 0:
        return np.array([1.0, 10.0])
    logs = np.log(values)
    if len(logs) == 1:
        return np.asarray(np.exp(logs[0] + np.array([-0.5, 0.5])))
    inner = 0.5 * (logs[1:] + logs[:-1])
    return np.asarray(np.exp([1.5 * logs[0] - 0.5 * logs[1], *inner, 1.5 * logs[-1] - 0.5 * logs[-2]]))
