"""What the study of three errors shows: the law nearest to the physics, misleading gradients, and traps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pandas as pd

from bench.experiment.axes import table
from bench.experiment.columns import COMMON, Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Table, Views
from bench.report.problems import label_columns, problem_names, problem_numbers
from bench.report.style import PALETTE
from bench.report.text import number
from bench.report.views import Arranged, arrange, attempted
from bench.report.writer import reasons
from bench.studies.three_errors.columns import COLUMNS
from bench.studies.three_errors.sections import (
    PROGRAM,
    WRONG,
    Section,
    Trap,
    joint_axes,
    programs_of,
    sections,
    traps,
)

AGREES = 1e-3
"""Largest program error of a gradient that is right for its program."""
FLOOR = 1e-16
"""Smallest error that is drawn; smaller ones, 0 included, are drawn here as upper limits."""
RESULTS = ("forward_error_rel", "program_error_rel", "model_error_rel", "model_cosine", "model_signs")
ERRORS = ("model_error_rel", "program_error_rel", "bias_rel", "forward_error_rel")
OWN, PHYSICS, TRAP = "program error", "model error", "model error of a trap"
STYLES = {
    OWN: Style(PALETTE[0], "o", meaning="program error: to differences of its own cost"),
    PHYSICS: Style(PALETTE[1], "s", meaning="model error: to the gradient of the physics"),
    TRAP: Style(PALETTE[2], "D", meaning="model error of a trap: its cost converges, its gradient does not"),
}
NOTE = (
    "Relative errors at theta, without noise except for the biases. forward: |cost - physics' cost|. program: gradient "
    "against the best central difference of the same program. model: gradient against the physics'. right signs: share "
    "of coordinates with the physics' sign. bias: of that estimator against grad J_sigma of the program, '< u' where it "
    "cannot be distinguished from 0 (95%). value: of the axis in the heading."
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return the law to use and what is misleading, a line per program and value of an axis, and the charts."""
    shown = arrange(experiment, rows)
    parts = sections(shown)
    trapped = traps(shown, parts)
    lines = Table(
        "three_errors", *_lines(shown, parts), data=table(experiment, rows), title="program, model and estimator error",
        notes=[*map(str, trapped), NOTE], terminal=True, split="section",
    )  # fmt: skip
    if not (attempted(rows)["status"] == "ok").any():
        return Views([lines], remarks=reasons(rows))
    compared = _compared(shown, parts, trapped)
    named = shown.rows.assign(
        law=problem_names(shown, ["contact", "integrator"], shown.axes, ("contact", "integrator")),
        problem=problem_names(shown, ["scene"], shown.axes),
    )
    worst = Table(
        "three_errors_wrong", *_wrong(named), title="Right for the program, wrong for the physics", files=[], page=True
    )
    charts = [_dumbbells(compared, parts, trapped), *_further(shown, named)]
    return Views([lines, worst], charts, named, remarks=reasons(rows))


def _compared(shown: Arranged, parts: Sequence[Section], trapped: Sequence[Trap]) -> pd.DataFrame:
    """Return a row per scene and law: along the time step at its smallest value, else at every value of the first axis."""
    part = next((part for part in parts if part.is_along_steps), parts[0])
    joint = joint_axes(shown, part.axis) if part.is_along_steps else []
    rows = part.rows if part.axis is None or joint else part.rows.assign(**{part.axis.column: part.rows["x"]})
    scene = problem_names(shown, ["scene"], joint or shown.axes, ["scene"], rows)
    # a law is named by what distinguishes it on its scene
    laws = [problem_names(shown, PROGRAM[1:], joint, ["contact"], own) for _, own in rows.groupby(scene, sort=False)]
    rows = rows.assign(
        panel=scene,
        law=pd.concat(laws),
        row=rows["key"].map(dict(zip(shown.rows["key"], shown.rows.index, strict=True))),
        trap=programs_of(shown, part).isin([trap.name for trap in trapped]) & part.is_along_steps,
    )
    return rows.sort_values("x", kind="stable").drop_duplicates(["panel", "law"]).sort_index()


# ------------------------------------------------------------------------------------------------------- tables


def _lines(shown: Arranged, parts: Sequence[Section]) -> tuple[pd.DataFrame, list[Column]]:
    """Return a line per program and value of a section's axis, with a bias per estimator, and the columns for readers."""
    lines: list[dict[Any, Any]] = []
    names, biases = dict.fromkeys(("scene", "contact")), dict[str, None]()
    for part in parts:
        without = joint_axes(shown, part.axis)
        rows = part.rows
        names |= dict.fromkeys(label_columns(shown, PROGRAM, without, rows=rows))
        laws = problem_numbers(rows, ("scene", "contact"), without)
        labels = problem_names(shown, ["estimator"], shown.axes, ["estimator"], rows)
        rows = rows.assign(program=problem_numbers(rows, PROGRAM, without), label=labels, place=pd.factorize(laws)[0])
        for _, group in rows.sort_values("place", kind="stable").groupby(["place", "program", "x"], sort=False):
            estimates = {f"bias {row['label']}": _bias(row) for _, row in group.drop_duplicates("label").iterrows()}
            biases |= dict.fromkeys(estimates)
            lines.append(group.iloc[0].to_dict() | estimates | {"section": part.heading})
    own = COLUMNS.by_name
    columns = [*(COMMON.get(name, Column(name, format="setting")) for name in names), *(own[name] for name in RESULTS)]
    value = [Column("x", label="value", format="setting")] if any(part.axis is not None for part in parts) else []
    frame = pd.DataFrame(lines, columns=None if lines else [*names, *RESULTS, "section", "x"])
    return frame, [*columns[: len(names)], *value, *columns[len(names) :], *map(text, biases)]


def _bias(row: pd.Series) -> str:
    if row["status"] != "ok":
        return str(row["status"])
    if row["bias_low"] > 0:
        return number(row["bias_rel"])
    return f"< {number(row['bias_high'] / row['reference_norm'])}"


def _wrong(named: pd.DataFrame) -> tuple[pd.DataFrame, list[Column]]:
    """Return a line per problem with misleading gradients: their number and the range of each error; and the columns."""
    wrong = named[(named["program_error_rel"] <= AGREES) & (named["model_error_rel"] > WRONG)]
    wrong = wrong.assign(law=wrong["problem"] + ", " + wrong["law"])
    ranges = wrong.groupby("law", sort=False)[list(ERRORS)].agg(
        lambda v: f"{number(v.min())} to {number(v.max())}" if v.notna().any() else "-"
    )
    counts = wrong.groupby("law", sort=False).size().rename("cells")
    worst = wrong.groupby("law", sort=False)["model_error_rel"].max().sort_values(ascending=False).index
    frame = ranges.join(counts).loc[worst].reset_index()
    return frame, [
        text("law", label="problem"),
        Column("cells", format="setting"),
        *(COLUMNS.by_name[name] for name in ERRORS),
    ]


# ------------------------------------------------------------------------------------------------------- charts


def _dumbbells(compared: pd.DataFrame, parts: Sequence[Section], trapped: Sequence[Trap]) -> Chart:
    """Return the main chart: for each scene and law, program and model error joined by a line, traps in red."""
    errors = pd.concat(
        [
            compared.assign(error=compared[name], series=series)
            for name, series in (("program_error_rel", OWN), ("model_error_rel", PHYSICS))
        ]
    ).sort_values("row", kind="stable")
    errors = errors[errors["error"].notna()].reset_index(drop=True)
    errors["series"] = errors["series"].mask(errors["trap"] & (errors["series"] == PHYSICS), TRAP)
    errors = errors.assign(limit=errors["error"] < FLOOR, error=errors["error"].clip(lower=FLOOR))
    steps = any(part.is_along_steps for part in parts)
    return Chart(
        "three_errors", errors,
        [replace(COLUMNS.by_name["model_error_rel"], name="error", label="relative error", limit="limit", log=True,
                 above_one="larger than the gradient")],
        [text("law", label="")], "dots", series="series", panel="panel", styles=STYLES, join=True, across=2, height=0.2,
        subtitle="At the smallest time step." if steps else "",
        text="The longer the line, the better a wrong gradient passes a check against differences of its own cost.",
    )  # fmt: skip


def _further(shown: Arranged, named: pd.DataFrame) -> list[Chart]:
    """Return the charts of the page: each error along the swept parameters, and the errors against each other."""
    frame = named.assign(row=named.index)
    model, *others = (replace(COLUMNS.by_name[name], log=True, above_one="larger than the gradient") for name in ERRORS)
    swept = [Column(axis.column, label=axis.title, format="setting") for axis in shown.swept()]
    along = Chart(
        "three_errors_swept", frame, swept,
        [model, *others], "points", series="law", panel="problem", printed=False,
    )  # fmt: skip
    against = Chart(
        "three_errors_pairs", frame, others,
        [model], "points", series="law", panel="problem", printed=False,
    )  # fmt: skip
    return [*([along] if swept else []), against]
