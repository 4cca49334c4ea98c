"""Writes the three errors of a gradient: tables, and one chart with a column per error and a row per scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from bench.experiment.axes import Axis
from bench.experiment.experiment import Experiment
from bench.report.figures import save, styled
from bench.report.page import WIDTH
from bench.report.problems import problem_names, problem_numbers, value_text
from bench.report.scales import log_axis
from bench.report.study_tables import label_columns, open_console, print_table, titled_figure, write_tables
from bench.report.style import GREY, MARKERS, SHADE, axis_name, colour, plain, symbol
from bench.report.tables import plain_markdown
from bench.report.text import axis_value, number
from bench.report.views import Arranged, arrange, attempted, merge_seeds, rows_along

FLOOR, CEILING = 1e-14, 1e3
"""Relative errors outside this range are drawn at its ends."""
ERRORS = {
    "forward_error_rel": "forward error\n(cost, to physics)",
    "program_error_rel": "program error\n(to differences)",
    "model_error_rel": "model error\n(to physics)",
}
"""Title of the column of panels of each error that does not depend on the estimator."""
EXACT = 1e-6
"""Program error up to which a gradient counts as exact."""
CONVERGED = 0.5
"""A cost or gradient converges if its error falls at least to this share from the largest to the smallest step."""
WRONG = 0.1
"""A gradient that does not converge is a trap if its model error at the smallest step is above this."""
AWAY: dict[str, Any] = {"marker": "x", "markersize": 6, "markeredgewidth": 1.6, "color": "#000000", "linestyle": "none"}
HOLLOW: dict[str, Any] = {"markerfacecolor": "white", "markeredgewidth": 0.9}
ORDER = (2, 0, 3, 4, 5, 6, 7, 1)
"""Positions in the palette of the first contact laws' colours."""
HEADERS = {
    "contact": "contact law", "forward_error_rel": "forward", "program_error_rel": "program",
    "model_error_rel": "model", "model_cosine": "cosine to physics", "model_signs": "right signs",
}  # fmt: skip
RESULTS = tuple(name for name in HEADERS if name != "contact")
PROGRAM = ("scene", "contact", "integrator", "backend")
"""Parts of the grid that identify a program. It has one bias per estimator."""
STEP = "dt"
"""Column of the time step, along which costs and gradients may converge."""
NOTES = (
    "Relative errors at theta, without noise except for the biases. forward: |cost - physics' cost|. program: gradient "
    "against the best central difference of the same program. model: gradient against the physics'. right signs: share "
    "of coordinates with the physics' sign. bias: of that estimator against grad J_sigma of the program, '< u' where it "
    "cannot be distinguished from 0 (95%).",
)


def write(experiment: Experiment, rows: pd.DataFrame) -> list[Path]:
    """Write ``three_errors`` (.csv, .md) and the chart along the time step, or the first swept axis if it is not swept."""
    shown = arrange(experiment, rows)
    parts = sections(shown)
    texts = [f"## {part.heading}\n\n{plain_markdown(readable(shown, part), HEADERS)}" for part in parts]
    title = f"# {experiment.name}: program, model and estimator error"
    paths = write_tables(experiment, rows, "three_errors", [title, *map(str, traps(shown)), *texts, *NOTES])
    drawn = figure(shown)
    if drawn is not None:
        paths += save(drawn, experiment.directory / "three_errors", experiment.formats)
    return paths


@dataclass(frozen=True, eq=False)
class Section:
    """The rows of one table, along an axis with its values in the column ``x``; without an axis, ``x`` is 0."""

    axis: Axis | None
    rows: pd.DataFrame

    @property
    def heading(self) -> str:
        """The heading of the table: ``Along dt [s], with horizon``."""
        return "Not along a swept axis" if self.axis is None else f"Along {self.axis.title}"


def sections(shown: Arranged) -> list[Section]:
    """Return a section per swept axis, with the programs that vary along it, then one with all other programs.

    In a section of an axis, all other axes are fixed at their most common value. Axes that step together have one
    section: the section of the time step if it is one of them, else of the first axis.
    """
    parts: list[Section] = []
    for axis in independent_axes(shown):
        joint = joint_axes(shown, axis)
        part = attempted(rows_along(shown, axis))
        for other in shown.axes:
            if other not in joint and other.column != "seed" and not part.empty:
                part = part[_is_most_common(part, other, shown)]
        if part.empty:
            continue
        varies = part.groupby(problem_numbers(part, PROGRAM, joint))["x"].transform("nunique") > 1
        if varies.any():
            parts.append(Section(axis, part[varies].sort_values("x", kind="stable")))
    rest = attempted(merge_seeds(shown.rows)).assign(x=0.0)
    programs = problem_numbers(rest, PROGRAM, shown.axes)
    listed = {key for part in parts for key in part.rows["key"]}
    rest = rest[~programs.isin(programs[rest["key"].isin(listed)])]
    return parts + ([] if rest.empty else [Section(None, rest)])


def independent_axes(shown: Arranged) -> list[Axis]:
    """Return the axes that have a section: one of each set of axes that step together."""
    axes: list[Axis] = []
    for axis in sorted(shown.axes, key=lambda axis: axis.column != STEP):
        if axis.column != "seed" and not any(axis.column in other.moves for other in axes):
            axes.append(axis)
    return [axis for axis in shown.axes if axis in axes]


def joint_axes(shown: Arranged, axis: Axis | None) -> list[Axis]:
    """Return an axis and the axes that step with it; empty for None."""
    return [] if axis is None else [axis, *(other for other in shown.axes if other.column in axis.moves)]


def _is_most_common(rows: pd.DataFrame, axis: Axis, shown: Arranged) -> pd.Series:
    """Return a mask of the rows at their scene and law's most common value of an axis, or without a value."""
    laws = problem_numbers(rows, ("scene", "contact"), shown.axes)
    mode = rows.groupby(laws)[axis.column].transform(lambda v: v.mode().iloc[0] if v.notna().any() else np.nan)
    return (rows[axis.column] == mode) | rows[axis.column].isna()


# ------------------------------------------------------------------------------------------------------- tables


def readable(shown: Arranged, part: Section) -> pd.DataFrame:
    """Return the table as strings: a line per program and value of the axis, with the errors and a bias per estimator."""
    rows, axis = part.rows, part.axis
    without = joint_axes(shown, axis)
    programs = problem_numbers(rows, PROGRAM, without)
    names = label_columns(shown, PROGRAM, without, rows=rows)
    labels = rows["estimator"].where(
        rows["estimator_params"] == "", rows["estimator"] + "[" + rows["estimator_params"] + "]"
    )
    laws = problem_numbers(rows, ("scene", "contact"), without)
    place = {law: i for i, law in enumerate(laws.unique())}
    rows = rows.assign(program=programs, label=labels, place=laws.map(place))
    lines = []
    for _, group in rows.groupby(["place", "program", "x"], sort=False):
        row = group.iloc[0]
        line = {name: value_text(row[name]) for name in names}
        line |= {} if axis is None else {replace(axis, moves=()).title: axis_value(row["x"])}
        line |= {name: number(row[name]) for name in RESULTS}
        line |= {f"bias {name}": _bias(estimates.iloc[0]) for name, estimates in group.groupby("label", sort=False)}
        lines.append((row["place"], line))
    return pd.DataFrame([line for _, line in sorted(lines, key=lambda pair: pair[0])])


def _bias(row: Any) -> str:
    if row["status"] != "ok":
        return str(row["status"])
    if row["bias_low"] > 0:
        return number(row["bias_rel"])
    return f"< {number(row['bias_high'] / row['reference_norm'])}"


def show(experiment: Experiment, rows: pd.DataFrame) -> None:
    """Print the tables and the traps."""
    shown = arrange(experiment, rows)
    console = open_console(experiment, rows)
    for part in sections(shown):
        texts = readable(shown, part)
        print_table(console, texts, HEADERS, set(texts) - set(PROGRAM), title=f"\n{part.heading}")
    console.print(*map(str, traps(shown)), *NOTES, sep="\n")


# -------------------------------------------------------------------------------------------------------- traps


@dataclass(frozen=True)
class Trap:
    """A program with a converging cost and an exact gradient that is nevertheless wrong for the physics.

    Its cosine to the physical gradient is negative at every step, or its model error does not converge with the step.
    """

    name: str
    """Name of the program: scene, law and the parameters that distinguish it."""
    program: float
    """Largest relative program error."""
    forward: tuple[float, float]
    """Relative forward error at the largest and the smallest value of the axis."""
    cosine: tuple[float, float]
    """Smallest and largest cosine to the physical gradient."""
    model: tuple[float, float]
    """Relative model error at the largest and the smallest value of the axis."""

    def __str__(self) -> str:
        """Format the trap as two sentences."""
        cosines = f"{number(self.cosine[0])} to {number(self.cosine[1])}"
        against = (
            f"but the cosine to the physical gradient is negative at every time step ({cosines})."
            if self.cosine[1] < 0
            else f"but the error to the physical gradient does not converge: it is {number(self.model[0])} at the largest time "
            f"step and {number(self.model[1])} at the smallest (cosine {cosines})."
        )
        return (
            f"Trap: {self.name}: the gradient agrees with differences to {number(self.program)}. The cost's error falls "
            f"from {number(self.forward[0])} to {number(self.forward[1])} with the time step, {against}"
        )


def traps(shown: Arranged) -> list[Trap]:
    """Return the programs that are traps along the time step."""
    part = next((part for part in sections(shown) if part.axis is not None and part.axis.column == STEP), None)
    if part is None:
        return []
    result = []
    for name, rows in part.rows.groupby(programs_of(shown, part), sort=False):
        steps = rows.drop_duplicates("x").sort_values("x")
        forward, cosine, program = steps["forward_error_rel"], steps["model_cosine"], steps["program_error_rel"].max()
        converges = forward.is_monotonic_increasing and forward.iloc[0] <= CONVERGED * forward.iloc[-1]
        model = steps["model_error_rel"]
        stays_wrong = model.iloc[0] > max(CONVERGED * model.iloc[-1], WRONG)
        if ((cosine < 0).all() or stays_wrong) and program <= EXACT and converges:
            ends, errors = ((float(v.iloc[-1]), float(v.iloc[0])) for v in (forward, model))
            result.append(Trap(str(name), float(program), ends, (float(cosine.min()), float(cosine.max())), errors))
    return result


def programs_of(shown: Arranged, part: Section, parts: Sequence[str] = PROGRAM) -> pd.Series:
    """Return, per row of a section, the name of its program, ``bounce_once, penalty``, which is the same along the axis."""
    always = [name for name in ("scene", "contact") if name in parts]
    return problem_names(shown, parts, joint_axes(shown, part.axis), always, part.rows)


# ------------------------------------------------------------------------------------------------------- charts


def figure(shown: Arranged) -> Figure | None:
    """Draw the errors along the time step, or the first axis if it is not swept; None without a swept axis.

    There is a row of panels per scene, a column per error, and a line per law.
    """
    parts = [part for part in sections(shown) if part.axis is not None]
    if not parts:
        return None
    part = min(parts, key=lambda part: part.axis is not None and part.axis.column != STEP)
    with styled():
        return _figure(shown, part, {trap.name for trap in traps(shown)})


def _figure(shown: Arranged, part: Section, trap_names: Set[str]) -> Figure:
    assert part.axis is not None
    panels = programs_of(shown, part, ["scene"])
    rows = part.rows.assign(
        panel=panels,
        law=_laws(shown, part, panels),
        trap=programs_of(shown, part).isin(trap_names if part.axis.column == STEP else ()),
        label=problem_names(shown, ["estimator"], shown.axes, ["estimator"], part.rows),
    )
    scenes, laws, estimators = (list(dict.fromkeys(rows[name])) for name in ("panel", "law", "label"))
    looks = {law: {"color": _colour(i), "marker": MARKERS[i % len(MARKERS)]} for i, law in enumerate(laws)}
    drawn = titled_figure(WIDTH, 1.45 * len(scenes) + 1.75, _title(part.axis, bool(rows["trap"].any())))
    grid = drawn.subplots(len(scenes), len(ERRORS) + len(estimators), squeeze=False, sharey=True)
    titles = [*ERRORS.values(), *(f"estimator error\n(bias of {plain(name)})" for name in estimators)]
    for panel, title in zip(grid[0], titles, strict=True):
        panel.set_title(title, pad=4)
    for line, scene in zip(grid, scenes, strict=True):
        own = rows[rows["panel"] == scene]
        for panel in line:
            _scale(panel, np.array(sorted(own["x"].unique())))
        for law, program in own.groupby("law", sort=False):
            _draw(line, program, estimators, looks[law] | (BOLD if program["trap"].any() else THIN))
        if own["trap"].any():
            for panel, (height, text) in zip(line, TRAP_LABELS, strict=False):
                panel.text(0.5, height, text, transform=panel.transAxes, ha="center", va="center", fontweight="bold")
        line[0].set_ylabel(plain(scene).replace("[", "\n[", 1))
    for panel in grid[-1]:
        panel.set_xlabel(_short_name(part.axis))
    drawn.legend(handles=_legend(looks), loc="outside lower center", ncols=3, columnspacing=1.2)
    return drawn


def _laws(shown: Arranged, part: Section, panels: pd.Series) -> pd.Series:
    """Return each row's law, named by the columns that distinguish it in its panel, so that each law has one style."""
    axes = ["contact", "integrator", "backend"]
    return pd.concat(
        [programs_of(shown, Section(part.axis, own), axes) for _, own in part.rows.groupby(panels, sort=False)]
    ).reindex(part.rows.index)


def _colour(place: int) -> str:
    return colour(ORDER[place] if place < len(ORDER) else place)


BOLD: dict[str, Any] = {"linewidth": 2.6, "markersize": 5.0, "zorder": 4}
TRAP_LABELS = (
    (0.3, "looks right:\nfalls with $\\Delta t$"),
    (0.68, "looks right:\nexact"),
    (0.42, "wrong\nat every $\\Delta t$"),
)
"""Heights and texts of the labels in the panels of a scene with a trap."""
THIN: dict[str, Any] = {"linewidth": 0.9, "markersize": 3.0, "zorder": 3}


def _title(axis: Axis, has_trap: bool) -> str:
    """Return the title of the chart, which explains traps if there are any."""
    text = f"Three errors of a gradient along {axis_name(axis)}, all relative"
    return text + (
        "\nBold: traps, with a converging cost and an exact derivative that the physics does not have"
        if has_trap
        else ""
    )


def _short_name(axis: Axis) -> str:
    """Return an axis's symbol and unit, short enough for a small panel."""
    return " ".join(filter(None, [symbol(axis.column) or plain(axis.short), f"[{axis.unit}]" if axis.unit else ""]))


def _scale(panel: Axes, values: np.ndarray) -> None:
    panel.set_yscale("log")
    panel.set_ylim(FLOOR / 10, CEILING * 3)
    panel.yaxis.set_major_locator(FixedLocator([1e-12, 1e-8, 1e-4, 1.0]))
    panel.yaxis.set_minor_locator(NullLocator())
    panel.axhspan(1.0, CEILING * 3, zorder=0, **SHADE)
    log_axis(panel, "x", values[0] / 1.4, values[-1] * 1.4)
    panel.xaxis.set_major_locator(FixedLocator(list(values)))
    few = values if len(values) <= 3 else values[[0, -1]]
    panel.xaxis.set_major_formatter(FuncFormatter(lambda x, _: number(x) if x in few else ""))
    panel.tick_params(axis="x", labelsize=6.5)


def _draw(line: Sequence[Axes], rows: pd.DataFrame, estimators: Sequence[str], style: Mapping[str, Any]) -> None:
    """Draw one law's errors in a scene's row of panels."""
    program = rows.drop_duplicates("x")
    for panel, name in zip(line, ERRORS, strict=False):
        panel.plot(program["x"], program[name].clip(FLOOR, CEILING), **style)
    away = program[program["model_cosine"] < 0]
    line[2].plot(away["x"], away["model_error_rel"].clip(FLOOR, CEILING), zorder=5, **AWAY)
    for panel, estimator in zip(line[len(ERRORS) :], estimators, strict=True):
        own = rows[(rows["label"] == estimator) & (rows["status"] == "ok")]
        limit = ~(own["bias_low"] > 0)
        value = (own["bias"].where(~limit, own["bias_high"]) / own["reference_norm"]).clip(FLOOR, CEILING)
        panel.plot(own["x"], value, **{**style, "marker": ""})
        for mask, look in ((~limit, {}), (limit, HOLLOW)):
            panel.plot(own["x"][mask], value[mask], **{**style, "linestyle": "none", **look})


def _legend(looks: Mapping[str, Mapping[str, Any]]) -> list[Any]:
    handles: list[Any] = [Line2D([], [], label=plain(law), **{**THIN, **look}) for law, look in looks.items()]
    handles.append(Line2D([], [], label="gradient against the physics' direction", **AWAY))
    hollow: dict[str, Any] = {"color": GREY, "marker": "o", "linestyle": "none", "markersize": 3.5, **HOLLOW}
    handles.append(Line2D([], [], label="bias not resolved: 95% limit", **hollow))
    handles.append(Patch(label="error exceeds what it is of", **SHADE))
    return handles
