"""Compares the gradients of physics engines: program and model error, bias, variance, time, memory and failures."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np

from bench.engines.problem import EngineProblem
from bench.experiment.cell import Cell
from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, text
from bench.experiment.session import Session
from bench.measure import noise, statistics, timing
from bench.model import Problem, param, zeroth_order

from .. import StudyPackage, finite_status, relative_error
from ..bias_variance.columns import COLUMNS as ESTIMATES
from ..three_errors import difference_check

SUMMARY = ("reference_norm", "reference_se", "bias", "bias_low", "bias_high", "variance", "rmse_rel")
"""Columns that are statistics of averaged gradients."""


@dataclass(frozen=True)
class Engines(StudyPackage):
    """Measures whether an engine's gradient is right, its bias and variance, and what it costs."""

    name = "engines"
    axes = ("scene", "contact", "integrator", "backend")
    timed = True
    columns: ClassVar[Columns] = Columns.of(
        Column("program_error_rel", "distance of the gradient from its best central difference, relative to that difference",
               label="program error", comparison=ComparisonRule("exact", "program error")),
        Column("difference_step", "step of the best central difference, in the units of theta"),
        Column("model_error_rel", "distance of the gradient from the gradient named in `model`, relative to its norm",
               label="model error", comparison=ComparisonRule("exact", "model error")),
        text("model", "what model_error_rel compares with: rigid contact in closed form, or the scene's own program"),
        *(ESTIMATES.by_name[name] for name in (*SUMMARY[:2], "reference_method", "reference_spacing", *SUMMARY[2:])),
        Column("zeroth_rmse_rel", "rmse_rel from `samples` costs with scores, without gradients", label="RMSE, costs only"),
        Column("nan_share", "share of the gradients that are not finite", label="NaN share"),
        Column("gradient_s", "time of `batch` gradients, median", "s", label="gradients", measured=True, format="seconds"),
        Column("value_s", "time of `batch` costs, median", "s", label="costs", measured=True, format="seconds"),
        Column("first_s", "time of the first gradients and costs, with starts and compilation", "s", label="first call",
               measured=True, format="seconds"),
        Column("pipe_share", "share of gradient_s outside the engine's process: pipes and copies", label="pipe", measured=True),
        Column("pass_share", "share of gradient_s in this process: costs, policy and adjoint pass", label="harness",
               measured=True),
        Column("memory_mb", "largest resident memory of the process that runs the engine", "MB", label="memory",
               measured=True),
        text("device", "device that computes, such as cpu or cuda:0"),
        text("engine_settings", "settings of an engine's process that can change its last digits: processors, environment "
             "variables, and its own, such as its determinism"),
        numbers("gradient", "gradient at theta without noise, by coordinate of theta",
                comparison=ComparisonRule("vector", "gradient")),
        numbers("model_gradient", "the gradient that model_error_rel compares with, by coordinate of theta"),
    )  # fmt: skip

    batch: int = param(64, "gradients in a timed call", positive=True)
    timed_calls: int = param(3, "timed calls", positive=True)

    def measure(self, cell: Cell, session: Session) -> dict[str, Any]:
        """Return one cell's results by column. Backends without gradients get the columns of costs only."""
        problem = session.problem(cell)
        program = problem.program
        theta, has_gradient = program.theta0, "grad" in cell.backend.provides
        result = _times(cell, problem, self, has_gradient)
        truth = session.references.of(cell)
        known, noted = truth.known(), truth.note or "the reference gradient is not finite"
        status = finite_status(noted, truth.batches)
        w = noise.shared(cell.seed, cell.scene.name, cell.repeats, cell.samples, program.n_noise)
        zeroth = zeroth_order(problem, theta, w).mean(axis=1)
        result |= {
            "reference_method": truth.method, "reference_spacing": truth.spacing, "device": problem.device,
            "zeroth_rmse_rel": statistics.summarise(zeroth, known, cell.samples).rmse_rel,
        }  # fmt: skip
        remark = "computes no gradients"
        if has_gradient:
            check = difference_check(problem)
            gradients = problem.grad(theta, w.reshape(-1, program.n_noise).T)
            means = gradients.T.reshape(cell.repeats, cell.samples, -1).mean(axis=1)
            summary = asdict(statistics.summarise(means, known, cell.samples))
            result |= {
                "gradient": check.gradient.tolist(),
                "program_error_rel": relative_error(check.gradient, check.difference),
                "difference_step": check.step,
                "nan_share": float(1.0 - np.isfinite(gradients).all(axis=0).mean()),
                **_model_error(cell, session, check.gradient), **{name: summary[name] for name in SUMMARY},
            }  # fmt: skip
            if status["status"] == "ok":
                status = finite_status("some gradients are not finite", gradients, check.gradient)
            remark = summary["note"]
        status["reason"] = "; ".join(filter(None, (status["reason"], remark)))
        if isinstance(problem, EngineProblem):
            result["engine_settings"] = ";".join(f"{name}={value}" for name, value in problem.settings.items())
        memory = problem.peak_memory_mb if isinstance(problem, EngineProblem) else timing.peak_memory_mb()
        return status | result | {"memory_mb": memory}


def _model_error(cell: Cell, session: Session, gradient: np.ndarray) -> dict[str, Any]:
    """Return the distance from the gradient of rigid contact or, where it is unknown, of the scene's own program."""
    expected, model = cell.program().physical_gradient(), "rigid contact"
    if expected is None:
        if not cell.ranked_backends:
            return {"model": ""}
        own = session.problems.of(cell.ranked_backends[0], cell)
        expected = own.grad(own.program.theta0, np.zeros((own.program.n_noise, 1)))[:, 0]
        model = "the scene's own program"
    error = relative_error(gradient, expected)
    return {"model": model, "model_gradient": expected.tolist(), "model_error_rel": error}


def _times(cell: Cell, problem: Problem, study: Engines, has_gradient: bool) -> dict[str, Any]:
    """Return the times of first and later calls, and the shares of a gradient's time outside the engine."""
    theta, n_noise = problem.program.theta0, problem.program.n_noise
    w = noise.shared(cell.seed, cell.scene.name, 1, study.batch, n_noise)[0].T
    functions: dict[str, Callable[..., np.ndarray]] = {"value_s": problem.value}
    if has_gradient:
        functions["gradient_s"] = problem.grad
    started = time.perf_counter()
    for function in functions.values():
        function(theta, w)
    result = {"first_s": time.perf_counter() - started}
    for name, function in functions.items():
        before = _inside(problem)
        started = time.perf_counter()
        _, clock = timing.timed(lambda _, function=function: function(theta, w), study.timed_calls)  # type: ignore[misc]
        elapsed = time.perf_counter() - started
        result[name] = clock.median_s
        if name == "gradient_s" and isinstance(problem, EngineProblem):
            engine, pipe = (after - earlier for after, earlier in zip(_inside(problem), before, strict=True))
            result |= {"pipe_share": pipe / elapsed, "pass_share": 1.0 - (engine + pipe) / elapsed}
    return result


def _inside(problem: Problem) -> tuple[float, float]:
    """Return the seconds so far inside the engine's process and in pipes; 0 in this process."""
    return (problem.engine_s, problem.pipe_s) if isinstance(problem, EngineProblem) else (0.0, 0.0)
