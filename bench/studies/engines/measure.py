"""Measures an engine's gradient on one scene: its errors, its statistics as an estimate, its time and its memory."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np

from bench.engines.problem import EngineProblem
from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import noise, statistics, timing
from bench.model import Problem, zeroth_order
from bench.studies import finite_status, relative_error
from bench.studies.engines import Engines
from bench.studies.three_errors.measure import difference_check

SUMMARY = ("reference_norm", "reference_se", "bias", "bias_low", "bias_high", "variance", "rmse_rel")
"""Columns that are statistics of averaged gradients."""


def measure(cell: Cell, session: Session, study: Engines) -> dict[str, Any]:
    """Return one cell's results by column. Backends without gradients get the columns of costs only."""
    problem = session.problem(cell)
    program = problem.program
    theta, has_gradient = program.theta0, "grad" in cell.backend.provides
    result = _times(cell, problem, study, has_gradient)
    truth = session.references.of(cell)
    known, noted = truth.known(), truth.note or "the reference gradient is not finite"
    status = finite_status(noted, truth.batches)
    w = noise.shared(cell.seed, cell.scene.name, cell.repeats, cell.samples, program.n_noise)
    zeroth = zeroth_order(problem, theta, w).mean(axis=1)
    result |= {
        "reference_method": truth.method, "device": problem.device,
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
