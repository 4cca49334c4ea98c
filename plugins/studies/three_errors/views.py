"""What the study of three errors shows: a line per cell, traps, and the errors of each law."""

from __future__ import annotations

import pandas as pd

from bench.experiment.columns import COMMON, Column, text
from bench.experiment.experiment import Experiment
from bench.experiment.views import Chart, Style, Table, Views
from bench.report.problems import problem_names
from bench.report.shown import Shown, floored, stacked
from bench.report.style import PALETTE

EXACT = 1e-6
"""Program error up to which a gradient counts as exact."""
CONVERGED = 0.5
"""A cost or gradient converges if its error falls at least to this share from the largest to the smallest step."""
WRONG = 0.1
"""Smallest model error of a wrong gradient."""
FLOOR = 1e-16
"""Smallest error that is drawn; smaller ones, 0 included, are drawn here as upper limits."""
PROGRAM = ("scene", "contact", "integrator", "backend")
"""Parts of the grid that identify a program, which is the same at every time step."""
RESULTS = ("forward_error_rel", "program_error_rel", "model_error_rel", "model_cosine", "model_signs")
OWN, PHYSICS, TRAP = "program error", "model error", "model error of a trap"
STYLES = {
    OWN: Style(PALETTE[0], "o", meaning="program error: to differences of its own cost"),
    PHYSICS: Style(PALETTE[1], "s", meaning="model error: to the gradient of the physics"),
    TRAP: Style(PALETTE[2], "D", meaning="model error of a trap: its cost converges, its gradient does not"),
}
NOTE = (
    "Relative errors at theta, without noise except for the estimator error. forward: |cost - physics' cost|. program: "
    "gradient against the best central difference of the same program. model: gradient against the physics'. right signs: "
    "share of coordinates with the physics' sign. estimator: bias against grad J_sigma of the program, with its 95% interval."
)
TRAP_NOTE = (
    "The gradient agrees with differences at every time step and the cost converges with the step. Yet the cosine to the physical "
    "gradient is negative at every step, or the model error does not converge. Errors are at the largest and the smallest step."
)


def views(experiment: Experiment, rows: pd.DataFrame) -> Views:
    """Return a line per cell, the traps and the chart."""
    shown = Shown(experiment, rows, ["dt"], ["estimator"], PROGRAM)
    ends = {f"bias_rel_{end}": shown.rows[f"bias_{end}"] / shown.rows["reference_norm"] for end in ("low", "high")}
    bias = shown.column("bias_rel", label="estimator error", low="bias_rel_low", high="bias_rel_high")
    cells = shown.cells(
        [COMMON["dt"], *map(shown.column, RESULTS), bias], "program, model and estimator error", [NOTE],
        ("scene", "contact", "estimator"), shown.rows.assign(**ends),
    )  # fmt: skip
    if shown.good.empty:
        return Views([cells])
    trapped, problem = traps(shown), text("problem")
    either = Column("largest", label="at the largest step"), Column("smallest", label="at the smallest step")
    tables = [
        cells,
        Table("three_errors_traps", trapped, [problem, text("error"), *either], title="Traps", notes=[TRAP_NOTE],
              files=["csv"] if len(trapped) else [], terminal=bool(len(trapped)), page=True),
    ]  # fmt: skip
    return Views(tables, [_dumbbells(shown, trapped)])


def along_steps(shown: Shown) -> pd.DataFrame:
    """Return the rows of the programs with several time steps, the smallest first; without any, all rows."""
    rows = shown.rows.sort_values("dt", kind="stable")
    varies = rows.groupby("problem")["dt"].transform("nunique") > 1
    return rows[varies] if varies.any() else shown.rows


def traps(shown: Shown) -> pd.DataFrame:
    """Return two or three lines per trap: its errors at the largest and the smallest time step. A missing error is no trap."""
    lines, names = [], ("forward_error_rel", "model_error_rel", "model_cosine")
    for problem, rows in along_steps(shown).groupby("problem", sort=False):
        steps = rows.drop_duplicates("dt")
        forward, model, cosine, program = (steps[name] for name in (*names, "program_error_rel"))
        converges = forward.is_monotonic_increasing and forward.iloc[0] <= CONVERGED * forward.iloc[-1]
        stays_wrong = model.iloc[0] > max(CONVERGED * model.iloc[-1], WRONG)
        is_trap = ((cosine < 0).all() or stays_wrong) and program.max(skipna=False) <= EXACT and converges
        if is_trap and len(steps) > 1:
            lines += [[problem, shown.column(name).heading, *steps[name].iloc[[-1, 0]]] for name in names]
    return pd.DataFrame(lines, columns=["problem", "error", "largest", "smallest"])


def _dumbbells(shown: Shown, trapped: pd.DataFrame) -> Chart:
    """Return the main chart: for each scene and law, program and model error joined by a line, traps in red."""
    rows = along_steps(shown)
    scene = problem_names(shown.arranged, ["scene"], shown.over or shown.arranged.axes, ["scene"], rows)
    # a law is named by what distinguishes it on its scene
    laws = [problem_names(shown.arranged, PROGRAM[1:], shown.over, ["contact"], own) for _, own in rows.groupby(scene)]
    rows = rows.assign(panel=scene, law=pd.concat(laws)).drop_duplicates(["panel", "law"]).sort_index()
    errors = stacked(rows, {OWN: "program_error_rel", PHYSICS: "model_error_rel"}, "error")
    errors = floored(errors.sort_values("row", kind="stable"), FLOOR, ["error"]).dropna(subset=["error"])
    is_trap = errors["problem"].isin(trapped["problem"]) & (errors["series"] == PHYSICS)
    return Chart(
        "three_errors", errors.assign(series=errors["series"].mask(is_trap, TRAP)).reset_index(drop=True),
        [Column("error", label="relative error", limit="error_limit", log=True, above_one="larger than the gradient")],
        [text("law", label="")], "dots", series="series", panel="panel", styles=STYLES, join=True, across=2, height=0.2,
        subtitle="At the smallest time step." if shown.over else "",
        text="The longer the line, the better a wrong gradient passes a check against differences of its own cost.",
    )  # fmt: skip
