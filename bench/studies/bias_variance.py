"""Bias, variance and cost of estimators against the certified gradient: the main study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench import noise, registry, statistics, timing
from bench.contracts import compilations
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
    parts, clock = timing.timed(lambda r: estimate(w[r : r + 1]), calls)
    usage = replace(problem.usage)
    if calls < cell.repeats:
        parts.append(estimate(w[calls:]))
    estimates = np.concatenate(parts)

    result: dict[str, Any] = {
        "status": "ok",
        "reference_method": truth.method,
        "model_error": truth.model_error,
        "time_s": clock.median_s,
        "time_iqr_s": clock.iqr_s,
        "time_samples": list(clock.samples_s),
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
        result["reason"] += f", the first in repeat {int(np.argmax(bad))} of seed {cell.seed}"
    return result


def truth_of(found: Reference) -> statistics.Truth:
    """The reference as the statistics take it."""
    if found.batches.shape[0] > 1:
        return statistics.Truth.from_batches(found.batches)
    return statistics.Truth.exact(found.gradient, found.error)


def write(experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str]) -> list[Path]:
    """Tables, charts and the printed table."""
    from bench.report import charts, tables, terminal, views

    names = sorted(registry.entries()["estimators"])
    smoothing = views.smoothing_parameters()
    paths = tables.write(rows, experiment.directory) + charts.write(experiment, rows, axes, names, smoothing)
    terminal.show(experiment, rows, axes, smoothing)
    return paths
