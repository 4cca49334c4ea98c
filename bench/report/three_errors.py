"""The three errors of a gradient as one table, and as charts with a panel per scene and contact law."""

from __future__ import annotations

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
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from bench.grid import Experiment, swept
from bench.report.figures import save, styled
from bench.report.page import WIDTH
from bench.report.scales import log_axis
from bench.report.style import GREY, PALETTE, SHADE, SYMBOLS, axis_name, plain
from bench.report.tables import plain_markdown
from bench.report.views import along, axis_value, number, ran, short_axis
from bench.store import write_whole

FLOOR, CEILING = 1e-14, 1e3
"""Relative errors outside are drawn at the edge."""
ERRORS: dict[str, tuple[str, dict[str, Any]]] = {
    "forward_error_rel": ("forward error of the cost", {"color": GREY, "linestyle": (0, (4, 1.5)), "marker": "s"}),
    "program_error_rel": ("program error (against differences)", {"color": PALETTE[0], "marker": "D"}),
    "model_error_rel": ("model error (against the physics)", {"color": "#000000", "marker": "o"}),
}
"""What is drawn of the program itself, with its name and look."""
ESTIMATORS: tuple[dict[str, Any], ...] = ({"color": PALETTE[2], "marker": "^"}, {"color": PALETTE[5], "marker": "v"})
"""The looks of the biases of estimators, in the order of the rows."""
AWAY: dict[str, Any] = {"marker": "x", "markersize": 7, "markeredgewidth": 2, "color": "#000000", "linestyle": "none"}
HOLLOW: dict[str, Any] = {"markerfacecolor": "white", "markeredgewidth": 0.9}
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
    """Write ``three_errors`` (.csv, .md) and a chart for the time step and for the laws' parameters; print the table."""
    tables = {axis: readable(part) for axis, part in _parts(experiment, rows).items()}
    text = "\n\n".join(
        f"## Along {short_axis(axis)}\n\n{plain_markdown(table, HEADERS)}" for axis, table in tables.items()
    )
    title = f"# {experiment.name}: program, model and estimator error"
    contents = {
        "three_errors.csv": rows.to_csv(index=False, lineterminator="\n"),
        "three_errors.md": "\n\n".join([title, text, *NOTES]) + "\n",
    }
    paths = [experiment.directory / name for name in contents]
    for path, content in zip(paths, contents.values(), strict=True):
        write_whole(path, content.encode())
    for name, figure in figures(experiment, rows).items():
        paths += save(figure, experiment.directory / name)
    _print(experiment, rows, tables)
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


def _print(experiment: Experiment, rows: pd.DataFrame, tables: Mapping[str, pd.DataFrame]) -> None:
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
    console.print(*NOTES)


# ------------------------------------------------------------------------------------------------------- charts


def figures(experiment: Experiment, rows: pd.DataFrame) -> dict[str, Figure]:
    """``three_errors`` along the time step, ``three_errors_parameters`` along the parameters of the contact laws."""
    parts = _parts(experiment, rows)
    estimators = list(dict.fromkeys(rows["estimator"]))
    steps = {axis: part for axis, part in parts.items() if short_axis(axis) == "dt"}
    laws = {axis: part for axis, part in parts.items() if short_axis(axis) != "dt"}
    drawn = {
        "three_errors": (steps, "Three errors of a gradient as the time step shrinks"),
        "three_errors_parameters": (laws, "Three errors of a gradient along the parameter of the contact law"),
    }
    with styled():
        return {name: _figure(chosen, estimators, title) for name, (chosen, title) in drawn.items() if chosen}


def _figure(parts: Mapping[str, pd.DataFrame], estimators: Sequence[str], title: str) -> Figure:
    """A row of panels per scene and a column per contact law and axis."""
    columns = [(axis, law) for axis, part in parts.items() for law in dict.fromkeys(part["contact"])]
    scenes = sorted({scene for part in parts.values() for scene in part["scene"]})
    height = 1.65 * len(scenes) + 1.55
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=9, fontweight="bold")
    grid = figure.subplots(len(scenes), len(columns), squeeze=False, sharey=True)
    for i, scene in enumerate(scenes):
        for j, (axis, law) in enumerate(columns):
            own = parts[axis][(parts[axis]["scene"] == scene) & (parts[axis]["contact"] == law)]
            _draw(grid[i, j], own, estimators)
            if i == 0:
                grid[i, j].set_title(_law_title(law), pad=4)
            if i == len(scenes) - 1:
                grid[i, j].set_xlabel(_short_name(axis))
        grid[i, 0].set_ylabel(plain(scene).replace("[", "\n[", 1) + "\nrelative error")
    figure.legend(handles=_legend(estimators), loc="outside lower center", ncols=3, columnspacing=1.2)
    return figure


def _law_title(law: str) -> str:
    """The identity string of a law, its parameters on a line of their own."""
    return plain(law.replace("time_of_impact=false", "no time of impact")).replace("[", "\n[", 1)


def _short_name(axis: str) -> str:
    """An axis with its symbol and unit where that fits under a small panel."""
    name = short_axis(axis)
    return axis_name(axis) if name in ("dt", "stiffness") else SYMBOLS.get(name, name) + _unit(name)


def _unit(name: str) -> str:
    return {"kappa": " [N m]", "beta": " [1/m]"}.get(name, "")


def _draw(panel: Axes, rows: pd.DataFrame, estimators: Sequence[str]) -> None:
    panel.set_yscale("log")
    panel.set_ylim(FLOOR / 10, CEILING * 3)
    panel.yaxis.set_major_locator(FixedLocator([1e-12, 1e-8, 1e-4, 1.0]))
    panel.yaxis.set_minor_locator(NullLocator())
    panel.axhspan(1.0, CEILING * 3, zorder=0, **SHADE)
    if rows.empty:
        panel.set_axis_off()
        return
    program = rows.drop_duplicates("x")
    for name, (_, style) in ERRORS.items():
        panel.plot(program["x"], program[name].clip(FLOOR, CEILING), **style, markersize=3.5)
    away = program[program["model_cosine"] < 0]
    panel.plot(away["x"], away["model_error_rel"].clip(FLOOR, CEILING), zorder=5, **AWAY)
    for estimator, style in zip(estimators, ESTIMATORS, strict=False):
        own = rows[(rows["estimator"] == estimator) & (rows["status"] == "ok")]
        limit = ~(own["bias_low"] > 0)
        value = own["bias"].where(~limit, own["bias_high"]) / own["reference_norm"]
        value = value.clip(FLOOR, CEILING)
        panel.plot(own["x"], value, **style | {"marker": ""}, linewidth=0.8)
        panel.plot(own["x"][~limit], value[~limit], **style, linestyle="none", markersize=3.5)
        panel.plot(own["x"][limit], value[limit], **style, linestyle="none", markersize=3.5, **HOLLOW)
    values = np.array(sorted(program["x"].unique()))
    log_axis(panel, "x", values[0] / 1.4, values[-1] * 1.4)
    panel.xaxis.set_major_locator(FixedLocator(list(values)))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda x, _: number(x) if x in (values[0], values[-1]) else ""))


def _legend(estimators: Sequence[str]) -> list[Any]:
    handles: list[Any] = [_handle(text, style) for text, style in ERRORS.values()]
    handles.append(Line2D([], [], label="gradient against the physics' direction", **AWAY))
    for estimator, style in zip(estimators, ESTIMATORS, strict=False):
        handles.append(_handle(f"bias of {estimator}", style))
    hollow: dict[str, Any] = {"color": GREY, "marker": "^", "linestyle": "none", "markersize": 3.5, **HOLLOW}
    handles.append(Line2D([], [], label="bias: 95% limit", **hollow))
    handles.append(Patch(label="error exceeds the gradient", **SHADE))
    return handles


def _handle(text: str, style: Mapping[str, Any]) -> Line2D:
    return Line2D([], [], label=text, markersize=3.5, **style)
