"""Compares the gradients of physics engines: program and model error, bias, variance, time, memory and failures."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.engines.problem import EngineProblem
from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, ComparisonRule, exact, numbers, seconds, text
from bench.experiment.experiment import Experiment
from bench.experiment.session import Session
from bench.experiment.views import Chart, Style, Views
from bench.measure import noise, timing
from bench.model import Problem, param, zeroth_order
from bench.report.style import PALETTE
from bench.report.text import number

from . import PARTS, StudyPackage, against_reference, all_noise, finite_status, relative_error
from .bias_variance.columns import COLUMNS as ESTIMATES
from .three_errors import difference_check

if TYPE_CHECKING:
    import pandas as pd

SUMMARY = ("reference_norm", "reference_se", "bias", "bias_low", "bias_high", "variance", "rmse_rel")
"""Columns that are statistics of averaged gradients."""
SAME = 0.1
"""Relative model error up to which a gradient counts as the gradient of the model."""
USELESS = 1.0
"""Relative RMSE from which on an estimate is no better than the zero estimate."""
SHOWN = (
    "program_error_rel",
    "model_error_rel",
    "rmse_rel",
    "zeroth_rmse_rel",
    "nan_share",
    "value_s",
    "gradient_s",
    "first_s",
    "pipe_share",
    "memory_mb",
)
DETAILS = (
    "difference_step",
    "model",
    "reference_norm",
    "reference_se",
    "reference_method",
    "bias",
    "bias_low",
    "bias_high",
    "variance",
    "pass_share",
)
"""Further columns of the page."""
LEVELS = {
    "right": Style(PALETTE[3], meaning="+: derivative of its program, and near the model's gradient"),
    "own": Style(PALETTE[0], meaning="o: derivative of its program, which is not near the model"),
    "noisy": Style("#e8b96a", meaning="~: derivative of its program, but averages are no better than 0"),
    "open": Style(PALETTE[4], meaning="?: derivative of its program; whether averages are better than 0 is open"),
    "wrong": Style(PALETTE[2], meaning="x: not the derivative of its program, or not finite"),
    "none": Style("0.85", meaning="-: no gradient, or the engine cannot run the scene"),
}
NOTES = (
    "Program error: distance of the gradient from differences of the engine's own cost. Model error: distance from rigid "
    "contact's gradient where it has a closed form, otherwise from the gradient of the scene's own program. RMSE: of "
    "`samples` averaged gradients, or costs with scores, relative to the engine's own grad J_sigma; where that is not "
    "known well enough, the upper end of the interval. Times are of `batch` rollouts. Pipe: share of the gradients' "
    "time that is spent outside the engine's process.",
)


@dataclass(frozen=True)
class Engines(StudyPackage):
    """Measures whether an engine's gradient is right, its bias and variance, and what it costs."""

    name = "engines"
    axes = PARTS
    timed = True
    columns = Columns.of(
        exact(
            "program_error_rel",
            "distance of the gradient from its best central difference, relative to that difference",
            "program error",
            "program error",
        ),
        Column("difference_step", "step of the best central difference, in the units of theta"),
        exact(
            "model_error_rel",
            "distance of the gradient from the gradient named in `model`, relative to its norm",
            "model error",
            "model error",
        ),
        text("model", "what model_error_rel compares with: rigid contact in closed form, or the scene's own program"),
        *(ESTIMATES.by_name[name] for name in (*SUMMARY[:2], "reference_method", "reference_spacing", *SUMMARY[2:])),
        Column(
            "zeroth_rmse_rel", "rmse_rel from `samples` costs with scores, without gradients", label="RMSE, costs only"
        ),
        Column("nan_share", "share of the gradients that are not finite", label="NaN share"),
        seconds("gradient_s", "time of `batch` gradients, median", "gradients"),
        seconds("value_s", "time of `batch` costs, median", "costs"),
        seconds("first_s", "time of the first gradients and costs, with starts and compilation", "first call"),
        Column(
            "pipe_share",
            "share of gradient_s outside the engine's process: pipes and copies",
            label="pipe",
            measured=True,
        ),
        Column(
            "pass_share",
            "share of gradient_s in this process: costs, policy and adjoint pass",
            label="harness",
            measured=True,
        ),
        Column(
            "memory_mb",
            "largest resident memory of the process that runs the engine",
            "MB",
            label="memory",
            measured=True,
        ),
        text("device", "device that computes, such as cpu or cuda:0"),
        text(
            "engine_settings",
            "settings of an engine's process that can change its last digits: processors, environment "
            "variables, and its own, such as its determinism",
        ),
        numbers(
            "gradient",
            "gradient at theta without noise, by coordinate of theta",
            comparison=ComparisonRule("vector", "gradient"),
        ),
        numbers("model_gradient", "the gradient that model_error_rel compares with, by coordinate of theta"),
    )

    batch: int = param(64, "gradients in a timed call", positive=True)
    timed_calls: int = param(3, "timed calls", positive=True)

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column. Backends without gradients get the columns of costs only."""
        problem = session.problem(cell)
        program = problem.program
        theta, has_gradient = program.theta0, "grad" in cell.backend.provides
        result = _times(cell, problem, self, has_gradient)
        truth = session.references.of(cell)
        w = all_noise(cell, program)
        zeroth = against_reference(problem, None, truth, zeroth_order(problem, theta, w).mean(axis=1), cell.samples)
        status = {"status": "ok", "reason": "computes no gradients"}
        result |= {
            "reference_method": truth.method,
            "reference_spacing": truth.spacing,
            "device": problem.device,
            "zeroth_rmse_rel": zeroth.get("rmse_rel"),
        }
        if has_gradient:
            _, gradient, difference, step = difference_check(problem)
            gradients = problem.grad(theta, w.reshape(-1, program.n_noise).T)
            means = gradients.T.reshape(cell.repeats, cell.samples, -1).mean(axis=1)
            first = against_reference(problem, None, truth, means, cell.samples)
            result |= {
                "gradient": gradient.tolist(),
                "program_error_rel": relative_error(gradient, difference),
                "difference_step": step,
                "nan_share": float(1.0 - np.isfinite(gradients).all(axis=0).mean()),
                **_model_error(cell, session, gradient),
                **{name: first.get(name) for name in SUMMARY},
            }
            status = finite_status("some gradients are not finite", gradients, gradient)
            status["reason"] = "; ".join(filter(None, (status["reason"], first["reason"])))
        if not truth.is_finite:
            status = {name: zeroth[name] for name in status}
        result["memory_mb"] = timing.peak_memory_mb()
        if isinstance(problem, EngineProblem):
            result["memory_mb"] = problem.peak_memory_mb
            result["engine_settings"] = ";".join(f"{name}={value}" for name, value in problem.settings.items())
        return status | result

    def show(self, experiment: Experiment, rows: pd.DataFrame) -> Views:
        """Return the table with a line per scene and engine, and the grid of usable gradients."""
        from bench.report.shown import Shown

        shown = Shown(experiment, rows)
        cells = with_limits(shown.rows)
        measured = cells["status"].isin(("ok", "nonfinite"))
        cells = cells.assign(level=np.where(measured, levels(cells), ""))
        columns = experiment.columns.by_name | {
            "rmse_rel": shown.column("rmse_rel", label="RMSE, gradients", limit="rmse_is_limit")
        }
        own, details = ([columns[name] for name in names] for names in (SHOWN, DETAILS))
        table = shown.cells([text("level", label="gradient"), *own], "gradients of physics engines", NOTES, rows=cells)
        charts = [_chart(cells[measured])] if measured.any() else []
        return Views([table], charts, with_limits(shown.arranged.rows), [*own, *details])


def _model_error(cell: Cell, session: Session, gradient: np.ndarray) -> dict[str, Any]:
    """Return the distance from the gradient of rigid contact or, where it is unknown, of the scene's own program."""
    expected, model = cell.program().physical_gradient(), "rigid contact"
    if expected is None:
        if not cell.ranked_backends:
            return {"model": ""}
        expected = session.problems.of(cell.ranked_backends[0], cell).grad()
        model = "the scene's own program"
    error = relative_error(gradient, expected)
    return {"model": model, "model_gradient": expected.tolist(), "model_error_rel": error}


def _times(cell: Cell, problem: Problem, study: Engines, has_gradient: bool) -> dict[str, Any]:
    """Return the times of first and later calls, and the shares of a gradient's time outside the engine."""
    theta, n_noise = problem.program.theta0, problem.program.n_noise
    w = noise.shared(cell.seed, cell.scene.name, 1, study.batch, n_noise)[0].T
    functions = {"value_s": problem.value} | ({"gradient_s": problem.grad} if has_gradient else {})
    started = time.perf_counter()
    for function in functions.values():
        function(theta, w)
    result = {"first_s": time.perf_counter() - started}

    def clocks() -> np.ndarray:
        return np.array([time.perf_counter(), *(getattr(problem, name, math.nan) for name in ("engine_s", "pipe_s"))])

    for name, function in functions.items():
        before = clocks()
        _, clock = timing.timed(lambda _, function=function: function(theta, w), study.timed_calls)  # type: ignore[misc]
        elapsed, engine, pipe = clocks() - before
        result[name] = clock.median_s
    return result | (
        {"pipe_share": pipe / elapsed, "pass_share": 1.0 - (engine + pipe) / elapsed} if has_gradient else {}
    )


# ------------------------------------------------------------------------------------------------- what is shown


def levels(rows: pd.DataFrame) -> np.ndarray:
    """Return the level of each row's gradient, a key of :data:`LEVELS`."""
    from bench.report.views import rmse_interval

    low, high = rmse_interval(with_variance_interval(rows))
    reach = 2.0 * rows["reference_se"] / rows["reference_norm"]
    low, high = low / (1.0 + reach), (high / (1.0 - reach)).where(reach < 1.0, np.inf)
    # a gradient counts as the derivative of its program up to a program error of 2%: differences of float32 costs have
    # two digits
    is_right = (rows["status"] == "ok") & ~(rows["nan_share"] > 0) & (rows["program_error_rel"] <= 0.02)
    kinds = {
        "none": rows["gradient"].map(len) == 0,
        "wrong": ~is_right,
        "noisy": low >= USELESS,
        "open": ~(high < USELESS),
        "right": rows["model_error_rel"] <= SAME,
    }
    return np.select(list(kinds.values()), list(kinds), "own")


def with_variance_interval(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows with the 95% interval of the variance of normal numbers, one per repeat."""
    from scipy.special import chdtri

    free = np.maximum(rows["repeats"] - 1, 1)
    sums = rows["variance"] * free
    return rows.assign(variance_low=sums / chdtri(free, 0.025), variance_high=sums / chdtri(free, 0.975))


def with_limits(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows whose RMSE, where only an upper limit is known, is that limit: see :func:`bench.report.views.shown_rmse`.

    The column ``rmse_is_limit`` is true there. Where the interval has no upper end the RMSE is missing.
    """
    from bench.report.views import shown_rmse

    value, *_, is_limit = shown_rmse(with_variance_interval(rows))
    return rows.assign(rmse_is_limit=is_limit, rmse_rel=value)


def _chart(measured: pd.DataFrame) -> Chart:
    """Return the grid of engines and scenes, coloured by level, with the model error of each gradient."""
    rigid = (measured["contact"] == "impulse") & (measured["contact"].nunique() > 1)
    letters = measured["level"].map({name: style.meaning[0] for name, style in LEVELS.items()})
    errors = (" " + measured["model_error_rel"].map(number)).mask(measured["level"] == "none", "")
    frame = measured.assign(place=measured["scene"] + np.where(rigid, ", rigid", ""), cell=letters + errors)
    return Chart(
        "engines",
        frame,
        [text("place", label="")],
        [text("method", label="")],
        "grid",
        level="level",
        cell="cell",
        styles=LEVELS,
        subtitle="number: relative distance from the model's gradient; rigid: with the law impulse",
        failed_name="not supported",
    )
