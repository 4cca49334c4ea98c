"""Measures program, model and estimator error of a gradient separately, and the forward error.

Program error: distance of the program's gradient from central differences of the program's cost. Model error: distance
from the gradient of the physics. Estimator error: bias of an estimator relative to the program's grad J_sigma. The
three are independent, and a small forward error (error of the cost) implies none of them is small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.columns import COMMON, Column, Columns, exact, numbers, text
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.views import Chart, Style, Table, Views
from bench.gradient import Lines, sampled
from bench.model import Problem, Program
from bench.report.style import PALETTE

from . import PARTS, StudyPackage, against_reference, all_noise, norm, ratio, relative_error
from .bias_variance.columns import COLUMNS as ESTIMATES

if TYPE_CHECKING:
    import pandas as pd

    from bench.report.shown import Shown

STEPS = 10.0 ** -np.arange(1.0, 9.5, 0.5)
"""Step sizes of the central differences, in the units of theta."""
CONVERGED = 0.5
"""A cost or gradient converges if its error falls at least to this share from the largest to the smallest step."""
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


@dataclass(frozen=True)
class ThreeErrors(StudyPackage):
    """Measures program, model and estimator error of a gradient, and the forward error."""

    name = "three_errors"
    columns = Columns.of(
        Column("cost", "cost f at theta, without noise"),
        Column("physical_cost", "cost of the physics at theta, without noise"),
        Column("forward_error", "difference of cost and physical_cost"),
        exact("forward_error_rel", "forward_error relative to physical_cost", "forward error", "forward error"),
        Column("program_norm", "norm of the program's gradient"),
        Column("program_error", "norm of (program's gradient - its best central difference)"),
        exact(
            "program_error_rel",
            "program_error relative to the norm of that difference",
            "program error",
            "program error",
        ),
        Column("difference_step", "step of the best central difference, in the units of theta"),
        Column("physical_norm", "norm of the physics' gradient"),
        Column("model_error", "norm of (program's gradient - physics' gradient)"),
        exact("model_error_rel", "model_error relative to physical_norm", "model error", "model error"),
        Column(
            "model_cosine", "cosine between the program's gradient and the physics' gradient", label="cosine to physics"
        ),
        Column("model_signs", "share of coordinates in which both gradients have the same sign", label="right signs"),
        *(
            ESTIMATES.by_name[name]
            for name in (
                "reference_norm",
                "reference_se",
                "bias",
                "bias_low",
                "bias_high",
                "bias_rel",
                "variance",
                "rmse_rel",
                "cosine",
                "sign_agreement",
                "reference_method",
                "reference_spacing",
            )
        ),
        numbers("gradient", "the program's gradient, by coordinate of theta"),
        numbers("physical_gradient", "the physics' gradient, by coordinate of theta"),
    )

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column: forward, program and model error at w = 0, and the bias of its estimator."""
        problem = session.problem(cell)
        cost, gradient, difference, step = difference_check(problem)
        truth = session.references.of(cell)
        result = {
            "cost": cost,
            "gradient": gradient.tolist(),
            "program_norm": norm(gradient),
            "program_error": norm(gradient - difference),
            "program_error_rel": relative_error(gradient, difference),
            "difference_step": step,
            **_against_physics(problem.program, cost, gradient),
        }
        estimates = cell.estimator.estimate(problem, problem.program.theta0, all_noise(cell, problem.program))
        compared = against_reference(problem, cell.estimator, truth, estimates, cell.samples)
        status = {} if np.isfinite(gradient).all() else {"status": "nonfinite"}
        return result | {name: value for name, value in compared.items() if name in self.columns.by_name} | status

    def show(self, experiment: Experiment, rows: pd.DataFrame) -> Views:
        """Return a line per cell, the traps and the chart."""
        from bench.report.shown import Shown

        shown = Shown(experiment, rows, ["dt"], ["estimator"], PARTS)
        ends = {f"bias_rel_{end}": shown.rows[f"bias_{end}"] / shown.rows["reference_norm"] for end in ("low", "high")}
        bias = shown.column("bias_rel", label="estimator error", low="bias_rel_low", high="bias_rel_high")
        cells = shown.cells(
            [COMMON["dt"], *map(shown.column, RESULTS), bias],
            "program, model and estimator error",
            [NOTE],
            ("scene", "contact", "estimator"),
            shown.rows.assign(**ends),
        )
        if shown.good.empty:
            return Views([cells])
        trapped, problem = traps(shown), text("problem")
        either = Column("largest", label="at the largest step"), Column("smallest", label="at the smallest step")
        tables = [
            cells,
            Table(
                "three_errors_traps",
                trapped,
                [problem, text("error"), *either],
                title="Traps",
                notes=[TRAP_NOTE],
                files=["csv"] if len(trapped) else [],
                terminal=bool(len(trapped)),
                page=True,
            ),
        ]
        return Views(tables, [_dumbbells(shown, trapped)])


def difference_check(problem: Problem) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Return cost and gradient ``(d,)`` at theta0 and w = 0, the central difference closest to the gradient, and its step.

    Truncation errors and jumps dominate at large steps, rounding at small steps. All costs are one batch.
    """
    theta, n_noise = problem.program.theta0, problem.program.n_noise
    gradient = problem.grad()
    samples, *_ = sampled(
        lambda at: problem.value(at, np.zeros((n_noise, at.shape[1]))),
        Lines(theta, np.eye(theta.size), gradient),
        float(np.finfo(np.float64).eps),
        STEPS,
    )
    differences = np.array([sample.differences for sample in samples])
    errors = np.linalg.norm(differences - gradient[:, None], axis=0)
    # without the mask, np.argmin would return the index of a NaN
    best = int(np.argmin(np.where(np.isfinite(errors), errors, np.inf)))
    return samples[0].centre, gradient, differences[:, best], float(STEPS[best])


def _against_physics(program: Program, cost: float, gradient: np.ndarray) -> dict[str, Any]:
    """Return the columns of forward and model error, as far as the scene has a physical cost and gradient.

    ``model_cosine`` is the cosine between the program's and the physical gradient. ``model_signs`` is the share of
    coordinates where their signs agree, among the coordinates where the physical gradient has a sign.
    """
    result: dict[str, Any] = {}
    known, physical = program.physical_cost(), program.physical_gradient()
    if known is not None:
        error = abs(cost - known)
        result |= {"physical_cost": known, "forward_error": error, "forward_error_rel": ratio(error, abs(known))}
    if physical is not None:
        signs, physical_signs = _signs(gradient), _signs(physical)
        has_sign = physical_signs != 0
        result |= {
            "physical_gradient": physical.tolist(),
            "physical_norm": norm(physical),
            "model_error": norm(gradient - physical),
            "model_error_rel": relative_error(gradient, physical),
            "model_cosine": ratio(float(gradient @ physical), norm(physical) * norm(gradient)),
            "model_signs": float((signs == physical_signs)[has_sign].mean()) if has_sign.any() else math.nan,
        }
    return result


def _signs(gradient: np.ndarray) -> np.ndarray:
    """Return the signs of a gradient's coordinates, 0 where a coordinate is rounding error."""
    # a coordinate below this share of the norm counts as rounding error, and its sign as 0
    return np.where(np.abs(gradient) > 1e-9 * norm(gradient), np.sign(gradient), 0.0)


# ------------------------------------------------------------------------------------------------- what is shown


def along_steps(shown: Shown) -> pd.DataFrame:
    """Return the rows of the programs with several time steps, the smallest first; without any, all rows."""
    rows = shown.rows.sort_values("dt", kind="stable")
    varies = rows.groupby("problem")["dt"].transform("nunique") > 1
    return rows[varies] if varies.any() else shown.rows


def traps(shown: Shown) -> pd.DataFrame:
    """Return two or three lines per trap: its errors at the largest and the smallest time step. A missing error is no trap."""
    import pandas as pd

    lines, names = [], ("forward_error_rel", "model_error_rel", "model_cosine")
    for problem, rows in along_steps(shown).groupby("problem", sort=False):
        steps = rows.drop_duplicates("dt")
        forward, model, cosine, program = (steps[name] for name in (*names, "program_error_rel"))
        converges = forward.is_monotonic_increasing and forward.iloc[0] <= CONVERGED * forward.iloc[-1]
        # a gradient is wrong from a model error of 10% on
        stays_wrong = model.iloc[0] > max(CONVERGED * model.iloc[-1], 0.1)
        # a gradient counts as exact up to a program error of 1e-6
        is_trap = ((cosine < 0).all() or stays_wrong) and program.max(skipna=False) <= 1e-6 and converges
        if is_trap and len(steps) > 1:
            lines += [[problem, shown.column(name).heading, *steps[name].iloc[[-1, 0]]] for name in names]
    return pd.DataFrame(lines, columns=["problem", "error", "largest", "smallest"])


def _dumbbells(shown: Shown, trapped: pd.DataFrame) -> Chart:
    """Return the main chart: for each scene and law, program and model error joined by a line, traps in red."""
    import pandas as pd

    from bench.report.problems import problem_names
    from bench.report.shown import stacked

    rows = along_steps(shown)
    scene = problem_names(shown.arranged, ["scene"], shown.over or shown.arranged.axes, ["scene"], rows)
    # a law is named by what distinguishes it on its scene
    laws = [problem_names(shown.arranged, PARTS[1:], shown.over, ["contact"], own) for _, own in rows.groupby(scene)]
    rows = rows.assign(panel=scene, law=pd.concat(laws)).drop_duplicates(["panel", "law"]).sort_index()
    errors = stacked(rows, {OWN: "program_error_rel", PHYSICS: "model_error_rel"}, "error")
    errors = errors.sort_values("row", kind="stable").dropna(subset=["error"])
    is_trap = errors["problem"].isin(trapped["problem"]) & (errors["series"] == PHYSICS)
    return Chart(
        "three_errors",
        errors.assign(series=errors["series"].mask(is_trap, TRAP)).reset_index(drop=True),
        [Column("error", label="relative error", least=1e-4, log=True, above_one="larger than the gradient")],
        [text("law", label="")],
        "dots",
        series="series",
        panel="panel",
        styles=STYLES,
        join=True,
        across=2,
        subtitle="at the smallest time step; " * bool(shown.over)
        + "the longer the line, the better a wrong gradient passes a check against differences of its own cost",
    )
