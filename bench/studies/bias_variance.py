"""Bias, variance and cost of estimators against the certified gradient: the main study."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench import noise, registry, statistics, timing
from bench.contracts import Problem, compilations
from bench.grid import Cell, Experiment
from bench.reference import Reference
from bench.session import Session
from bench.store import BIAS_VARIANCE

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = BIAS_VARIANCE

TIMED_CALLS = 5
"""Estimates timed one by one on backends that do not compile; the other repeats are evaluated together."""


def measure(cell: Cell, session: Session) -> dict[str, Any]:
    """Estimates of one cell held against the reference."""
    compilations.restart()
    program = cell.program()
    theta = cell.scene.theta0()
    truth = session.references.of(cell)
    problem = session.problem(cell)
    w = noise.shared(cell.seed, cell.scene.name, cell.repeats, cell.samples, program.n_noise)

    def estimate(block: np.ndarray) -> np.ndarray:
        result = np.asarray(cell.estimator.estimate(problem, theta, block), dtype=np.float64)
        if result.shape != (block.shape[0], problem.dim):
            raise ValueError(
                f"{cell.estimator.name} returned shape {result.shape}, not {(block.shape[0], problem.dim)}"
            )
        return result

    timing.reset_peak_memory()
    calls = cell.repeats if cell.backend.compiles else min(TIMED_CALLS, cell.repeats)
    problem.reset_usage()
    started = time.perf_counter()
    parts, clock = timing.timed(lambda r: estimate(w[r : r + 1]), calls)
    usage = replace(problem.usage)
    if calls < cell.repeats:
        parts.append(estimate(w[calls:]))
    spent = time.perf_counter() - started
    estimates = np.concatenate(parts)

    result: dict[str, Any] = {
        "status": "ok",
        "reference_method": truth.method,
        "model_error": truth.model_error,
        "time_s": clock.median_s,
        "time_iqr_s": clock.iqr_s,
        "time_samples": list(clock.samples_s),
        "estimates_s": spent,
        "compile_s": usage.compile_s,
        "rollouts": usage.rollouts / clock.calls,
        "gradients": usage.gradients / clock.calls,
        "peak_memory_mb": timing.peak_memory_mb(),
        "device": problem.device,
        "compilations": compilations.made,
        "shapes": " ".join(sorted(compilations.shapes)),
    }
    if not np.isfinite(truth.batches).all():
        return result | {"status": "nonfinite", "reason": "the reference gradient is not finite"}
    summary = asdict(statistics.summarise(estimates, truth_of(truth), cell.samples))
    result |= {"reason": summary.pop("note"), **summary}
    bad = ~np.isfinite(estimates).all(axis=1)
    if bad.any():
        result["status"] = "nonfinite"
        result["reason"] += f"; {first_bad(cell, problem, w, int(np.argmax(bad)))}"
    return result


def first_bad(cell: Cell, problem: Problem, w: np.ndarray, repeat: int) -> str:
    """Where an estimate that is not finite comes from, so that it can be repeated: theta, seed and sample.

    The sample is the first of the repeat ``w[repeat]`` whose own cost or gradient is not finite; an estimator may
    also spoil finite ones, or displace theta.
    """
    theta, samples = cell.scene.theta0(), w[repeat].T
    spoilt = ~np.isfinite(problem.value(theta, samples))
    if "grad" in cell.backend.provides:
        spoilt |= ~np.isfinite(problem.grad(theta, samples)).all(axis=0)
    sample = f"sample {int(np.argmax(spoilt))}" if spoilt.any() else "no single sample, costs and gradients are finite"
    text = np.array2string(theta, precision=17, threshold=8, separator=", ").replace("\n", "")
    return f"the first at seed {cell.seed}, repeat {repeat}, {sample}, theta {text}"


def truth_of(found: Reference) -> statistics.Truth:
    """The reference as the statistics take it."""
    if found.batches.shape[0] > 1:
        return statistics.Truth.from_batches(found.batches)
    return statistics.Truth.exact(found.gradient, found.error)


def write(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> list[Path]:
    """Tables, charts and the printed table."""
    from bench.report import charts, fastest, tables, terminal, views

    names = sorted(registry.entries()["estimators"])
    smoothing = views.smoothing_parameters()
    paths = tables.write(rows, experiment.directory) + charts.write(experiment, rows, axes, names, smoothing)
    terminal.show(experiment, rows, axes, smoothing)
    return paths + fastest.write(experiment, rows)
