"""The three errors of a gradient as one table, and as one chart with a column per error and a row per scene."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from bench.grid import Experiment, swept
from bench.report.figures import save, styled
from bench.report.page import WIDTH
from bench.report.scales import log_axis
from bench.report.style import GREY, MARKERS, PALETTE, SHADE, SYMBOLS, axis_name, plain
from bench.report.tables import plain_markdown
from bench.report.views import along, axis_value, number, ran, short_axis
from bench.store import write_whole

FLOOR, CEILING = 1e-14, 1e3
"""Relative errors outside are drawn at the edge."""
ERRORS = {
    "forward_error_rel": "forward error\n(cost, to physics)",
    "program_error_rel": "program error\n(to differences)",
    "model_error_rel": "model error\n(to physics)",
}
"""What is drawn of the program itself, a column each."""
EXACT = 1e-6
"""Program error up to which a gradient passes for exact."""
CONVERGED = 0.5
"""Forward error at the smallest step over that at the largest, up to which a cost passes for one that converges."""
AWAY: dict[str, Any] = {"marker": "x", "markersize": 6, "markeredgewidth": 1.6, "color": "#000000", "linestyle": "none"}
HOLLOW: dict[str, Any] = {"markerfacecolor": "white", "markeredgewidth": 0.9}
COLOURS = (PALETTE[2], PALETTE[0], PALETTE[3], PALETTE[4], PALETTE[5], PALETTE[6], PALETTE[7], PALETTE[1])
HEADERS = {
    "scene": "scene", "contact": "contact law", "x": "", "forward_error_rel": "forward", "program_error_rel": "program",
    "model_error_rel": "model", "model_cosine": "cosine to physics", "model_signs": "right signs",
}  # fmt: skip
NOTES = (
    "Relative errors at theta, without noise but for the biases. forward: |cost - physics' cost|. program: gradient "
    "against the best central difference of the same program. model: gradient against the physics'. right signs: share "
    "of coordinates with the physics' sign. bias: of that estimator against grad J_sigma of the program, '< u' when it "
    "cannot be told from 0 (95%).",
)


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``three_errors`` (.csv, .md) and its chart along the first swept axis; print the table."""
    tables = {axis: readable(part) for axis, part in _parts(experiment, rows).items()}
    told = [str(trap) for trap in traps(experiment, rows)]
    text = "\n\n".join(
        f"## Along {short_axis(axis)}\n\n{plain_markdown(table, HEADERS)}" for axis, table in tables.items()
    )
    title = f"# {experiment.name}: program, model and estimator error"
    contents = {
        "three_errors.csv": rows.to_csv(index=False, lineterminator="\n"),
        "three_errors.md": "\n\n".join([title, *told, text, *NOTES]) + "\n",
    }
    paths = [experiment.directory / name for name in contents]
    for path, content in zip(paths, contents.values(), strict=True):
        write_whole(path, content.encode())
    drawn = figure(experiment, rows)
    if drawn is not None:
        paths += save(drawn, experiment.directory / "three_errors")
    _print(experiment, rows, tables, told)
    return paths


def _parts(experiment: Experiment, rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Of each swept axis the rows of the scenes and laws that move along it, with its values in a column ``x``."""
    parts: dict[str, pd.DataFrame] = {}
    for axis in swept(experiment.sweep):
        name = short_axis(axis)
        if name in ("horizon", "seed", *map(short_axis, parts)):
            continue
        part = ran(along(rows, axis, experiment))
        for other in ("dt", "stiffness", "smoothing"):
            if other in part and name != other and not part.empty:
                part = part[_at_commonest(part, other)]
        moving = part.groupby(["scene", "contact"])["x"].transform("nunique") > 1
        if moving.any():
            parts[axis] = part[moving].sort_values("x", kind="stable")
    return parts


def _at_commonest(rows: pd.DataFrame, column: str) -> pd.Series:
    """Mask of the rows whose value of a column is the commonest of their scene and law: the others sweep that column."""
    middle = rows.groupby(["scene", "contact"])[column].transform(
        lambda v: v.mode().iloc[0] if v.notna().any() else np.nan
    )
    return (rows[column] == middle) | middle.isna()


# ------------------------------------------------------------------------------------------------------- tables


def readable(rows: pd.DataFrame) -> pd.DataFrame:
    """A table of texts: a line per scene, law and value of the axis, the errors, and a bias per estimator."""
    lines = []
    for (scene, contact, x), part in rows.groupby(["scene", "contact", "x"], sort=False):
        row = part.iloc[0]
        line = {"scene": scene, "contact": contact, "x": axis_value(x)}
        line |= {name: number(row[name]) for name in HEADERS if name not in line}
        line |= {f"bias {estimator}": _bias(own.iloc[0]) for estimator, own in part.groupby("estimator", sort=False)}
        lines.append(line)
    order = rows[["scene", "contact"]].drop_duplicates().reset_index(drop=True)
    rank = {(s, c): i for i, (s, c) in enumerate(order.itertuples(index=False))}
    table = pd.DataFrame(lines)
    table = table.sort_values(
        "contact", key=lambda _: [rank[k] for k in zip(table["scene"], table["contact"], strict=True)], kind="stable"
    )
    return table.reset_index(drop=True)


def _bias(row: Any) -> str:
    if row["status"] != "ok":
        return str(row["status"])
    if row["bias_low"] > 0:
        return number(row["bias_rel"])
    return f"< {number(row['bias_high'] / row['reference_norm'])}"


def _print(experiment: Experiment, rows: pd.DataFrame, tables: Mapping[str, pd.DataFrame], told: Sequence[str]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = max(console.width, 140)
    counts = ", ".join(f"{n} {status}" for status, n in rows["status"].value_counts().items())
    console.print(f"\n{experiment.name}: {experiment.question}\n{len(rows)} cells: {counts}")
    for axis, texts in tables.items():
        shown = Table(title=f"\nalong {short_axis(axis)}", title_justify="left", box=None, padding=(0, 2, 0, 0))
        for name in texts:
            shown.add_column(
                HEADERS.get(name, name) or short_axis(axis), justify="left" if name in ("scene", "contact") else "right"
            )
        for row in texts.fillna("").to_numpy():
            shown.add_row(*map(str, row))
        console.print(shown)
    console.print(*told, *NOTES, sep="\n")


# -------------------------------------------------------------------------------------------------------- traps


@dataclass(frozen=True)
class Trap:
    """A scene and law whose gradient passes every test but the physics': exact, of a cost that converges, and turned away."""

    scene: str
    contact: str
    program: float
    """Largest relative program error."""
    forward: tuple[float, float]
    """Relative forward error at the largest and the smallest value of the axis."""
    cosine: tuple[float, float]
    """Smallest and largest cosine to the physical gradient, both negative."""

    def __str__(self) -> str:
        """One sentence."""
        return (
            f"Trap: {self.scene}, {self.contact}: the gradient agrees with differences to {number(self.program)}, the "
            f"cost's error falls from {number(self.forward[0])} to {number(self.forward[1])}, and the gradient's cosine "
            f"to the physics is {number(self.cosine[0])} to {number(self.cosine[1])}, negative at every time step."
        )


def traps(experiment: Experiment, rows: pd.DataFrame) -> list[Trap]:
    """The scenes and laws that are traps along the time step."""
    steps = [part for axis, part in _parts(experiment, rows).items() if short_axis(axis) == "dt"]
    found = []
    for (scene, contact), part in itertools.chain(*(part.groupby(["scene", "contact"], sort=False) for part in steps)):
        own = part.drop_duplicates("x").sort_values("x")
        forward, cosine, program = own["forward_error_rel"], own["model_cosine"], own["program_error_rel"].max()
        converges = forward.is_monotonic_increasing and forward.iloc[0] <= CONVERGED * forward.iloc[-1]
        if (cosine < 0).all() and program <= EXACT and converges:
            ends = (float(forward.iloc[-1]), float(forward.iloc[0]))
            found.append(
                Trap(str(scene), str(contact), float(program), ends, (float(cosine.min()), float(cosine.max())))
            )
    return found


# ------------------------------------------------------------------------------------------------------- charts


def figure(experiment: Experiment, rows: pd.DataFrame) -> Figure | None:
    """A row of panels per scene, a column per error and a line per contact law, along the first swept axis; traps bold."""
    parts = _parts(experiment, rows)
    if not parts:
        return None
    axis, part = next(iter(parts.items()))
    with styled():
        return _figure(axis, part, {(trap.scene, trap.contact) for trap in traps(experiment, rows)})


def _figure(axis: str, rows: pd.DataFrame, trapped: Set[tuple[str, str]]) -> Figure:
    scenes, laws, estimators = (list(dict.fromkeys(rows[name])) for name in ("scene", "contact", "estimator"))
    looks = {
        law: {"color": c, "marker": m} for law, c, m in zip(laws, itertools.cycle(COLOURS), itertools.cycle(MARKERS))
    }
    drawn = Figure(figsize=(WIDTH, 1.45 * len(scenes) + 1.75), layout="constrained")
    FigureCanvasAgg(drawn)
    drawn.suptitle(_title(axis, bool(trapped)), fontsize=9, fontweight="bold")
    grid = drawn.subplots(len(scenes), len(ERRORS) + len(estimators), squeeze=False, sharey=True)
    titles = [*ERRORS.values(), *(f"estimator error\n(bias of {plain(name)})" for name in estimators)]
    for panel, title in zip(grid[0], titles, strict=True):
        panel.set_title(title, pad=4)
    for line, scene in zip(grid, scenes, strict=True):
        own = rows[rows["scene"] == scene]
        for panel in line:
            _scale(panel, np.array(sorted(own["x"].unique())))
        for law, part in own.groupby("contact", sort=False):
            _draw(line, part, estimators, looks[law] | (BOLD if (scene, law) in trapped else THIN))
        if any((scene, law) in trapped for law in laws):
            for panel, (height, text) in zip(line, SAID, strict=False):
                panel.text(0.5, height, text, transform=panel.transAxes, ha="center", va="center", fontweight="bold")
        line[0].set_ylabel(plain(scene).replace("[", "\n[", 1))
    for panel in grid[-1]:
        panel.set_xlabel(_short_name(axis))
    drawn.legend(handles=_legend(looks), loc="outside lower center", ncols=3, columnspacing=1.2)
    return drawn


BOLD: dict[str, Any] = {"linewidth": 2.6, "markersize": 5.0, "zorder": 4}
SAID = (
    (0.3, "looks right:\nfalls with $\\Delta t$"),
    (0.68, "looks right:\nexact"),
    (0.42, "wrong direction\nat every $\\Delta t$"),
)
"""What the panels of a scene with a trap say of it, at which height."""
THIN: dict[str, Any] = {"linewidth": 0.9, "markersize": 3.0, "zorder": 3}


def _title(axis: str, trapped: bool) -> str:
    """What is drawn, and what is to be seen first."""
    text = f"Three errors of a gradient along {axis_name(axis)}, all relative"
    return text + ("\nBold is a trap: right cost, exact derivative, wrong direction" if trapped else "")


def _short_name(axis: str) -> str:
    """An axis with its symbol and unit where that fits under a small panel."""
    name = short_axis(axis)
    return axis_name(axis) if name in ("dt", "stiffness") else SYMBOLS.get(name, name) + _unit(name)


def _unit(name: str) -> str:
    return {"kappa": " [N m]", "beta": " [1/m]"}.get(name, "")


def _scale(panel: Axes, values: np.ndarray) -> None:
    panel.set_yscale("log")
    panel.set_ylim(FLOOR / 10, CEILING * 3)
    panel.yaxis.set_major_locator(FixedLocator([1e-12, 1e-8, 1e-4, 1.0]))
    panel.yaxis.set_minor_locator(NullLocator())
    panel.axhspan(1.0, CEILING * 3, zorder=0, **SHADE)
    log_axis(panel, "x", values[0] / 1.4, values[-1] * 1.4)
    panel.xaxis.set_major_locator(FixedLocator(list(values)))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda x, _: number(x) if x in (values[0], values[-1]) else ""))


def _draw(line: Sequence[Axes], rows: pd.DataFrame, estimators: Sequence[str], style: Mapping[str, Any]) -> None:
    """One law of a scene in each of its panels."""
    program = rows.drop_duplicates("x")
    for panel, name in zip(line, ERRORS, strict=False):
        panel.plot(program["x"], program[name].clip(FLOOR, CEILING), **style)
    away = program[program["model_cosine"] < 0]
    line[2].plot(away["x"], away["model_error_rel"].clip(FLOOR, CEILING), zorder=5, **AWAY)
    for panel, estimator in zip(line[len(ERRORS) :], estimators, strict=True):
        own = rows[(rows["estimator"] == estimator) & (rows["status"] == "ok")]
        limit = ~(own["bias_low"] > 0)
        value = (own["bias"].where(~limit, own["bias_high"]) / own["reference_norm"]).clip(FLOOR, CEILING)
        panel.plot(own["x"], value, **{**style, "marker": ""})
        for mask, look in ((~limit, {}), (limit, HOLLOW)):
            panel.plot(own["x"][mask], value[mask], **{**style, "linestyle": "none", **look})


def _legend(looks: Mapping[str, Mapping[str, Any]]) -> list[Any]:
    handles: list[Any] = [Line2D([], [], label=_law_name(law), **{**THIN, **look}) for law, look in looks.items()]
    handles.append(Line2D([], [], label="gradient against the physics' direction", **AWAY))
    hollow: dict[str, Any] = {"color": GREY, "marker": "o", "linestyle": "none", "markersize": 3.5, **HOLLOW}
    handles.append(Line2D([], [], label="bias not resolved: 95% limit", **hollow))
    handles.append(Patch(label="error exceeds what it is of", **SHADE))
    return handles


def _law_name(law: str) -> str:
    """The identity string of a law in words."""
    return plain(law.replace("[time_of_impact=false]", ", no time of impact"))
