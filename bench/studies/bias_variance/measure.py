"""Estimates of one cell against the certified gradient, timed."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from bench.measure import noise, statistics, timing
from bench.model import SURROGATE, Auxiliaries, Problem
from bench.sweep.cell import Cell
from bench.sweep.session import Session


def measure(cell: Cell, session: Session, timed_calls: int) -> dict[str, Any]:
    """Measure one cell's estimates; ``timed_calls`` of them are timed one by one on backends that do not compile."""
    session.compilations.restart()
    program = cell.program()
    theta = program.theta0
    truth = session.references.of(cell)
    problem = session.problem(cell)
    w = noise.shared(cell.seed, cell.scene.name, cell.repeats, cell.samples, program.n_noise)

    decided: dict[int, Auxiliaries] = {}

    def estimate(start: int, stop: int) -> np.ndarray:
        block = w[start:stop]
        result, decided[start] = cell.estimator.explained(problem, theta, block)
        result = np.asarray(result, dtype=np.float64)
        if result.shape != (block.shape[0], problem.dim):
            raise ValueError(
                f"{cell.estimator.name} returned shape {result.shape}, not {(block.shape[0], problem.dim)}"
            )
        return result

    timing.reset_peak_memory()
    calls = cell.repeats if cell.backend.compiles else min(timed_calls, cell.repeats)
    # usage covers the timed calls only: the reference may have used the same problem
    problem.reset_usage()
    started = time.perf_counter()
    parts, clock = timing.timed(lambda r: estimate(r, r + 1), calls)
    # a copy, since the remaining estimates count on
    usage = replace(problem.usage)
    if calls < cell.repeats:
        parts.append(estimate(calls, cell.repeats))
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
        "compilations": session.compilations.made,
        "shapes": " ".join(sorted(session.compilations.shapes)),
        "mean_estimate": estimates.mean(axis=0).tolist(),
        "reference_gradient": truth.gradient.tolist(),
        "auxiliaries": summarised([decided[start] for start in sorted(decided)]),
    }
    if not np.isfinite(truth.batches).all():
        return result | {"status": "nonfinite", "reason": "the reference gradient is not finite"}
    unbiased = cell.estimator.declares_unbiased(program)
    summary = asdict(statistics.summarise(estimates, truth.known(), cell.samples, unbiased=unbiased))
    surrogate = SURROGATE if program.surrogate and "grad" in cell.estimator.needs else ""
    result |= {"reason": "; ".join(part for part in (surrogate, summary.pop("note"), truth.note) if part), **summary}
    bad = ~np.isfinite(estimates).all(axis=1)
    if bad.any():
        result["status"] = "nonfinite"
        result["reason"] += f"; {first_bad(cell, problem, w, int(np.argmax(bad)))}"
    return result


def summarised(decided: list[Auxiliaries]) -> str:
    """Return as JSON, for each auxiliary, its mean, its 5, 50 and 95% quantiles and the share of exact zeros."""
    table = {}
    for name in decided[0]:
        values = np.concatenate([np.ravel(one[name]) for one in decided]).astype(np.float64)
        if np.isfinite(values).all():
            low, median, high = np.quantile(values, (0.05, 0.5, 0.95)).tolist()
            table[name] = {
                "mean": float(values.mean()), "low": low, "median": median, "high": high,
                "zero": float((values == 0).mean()),
            }  # fmt: skip
    return json.dumps(table) if table else ""


def first_bad(cell: Cell, problem: Problem, w: np.ndarray, repeat: int) -> str:
    """Return where an estimate that is not finite comes from, so that it can be repeated: theta, seed and sample.

    The sample is the first of the repeat ``w[repeat]`` whose own cost or gradient is not finite; an estimator may
    also spoil finite ones, or displace theta.
    """
    theta, samples = problem.program.theta0, w[repeat].T
    spoilt = ~np.isfinite(problem.value(theta, samples))
    if "grad" in cell.backend.provides:
        spoilt |= ~np.isfinite(problem.grad(theta, samples)).all(axis=0)
    sample = f"sample {int(np.argmax(spoilt))}" if spoilt.any() else "no single sample, costs and gradients are finite"
    text = np.array2string(theta, precision=17, threshold=8, separator=", ").replace("\n", "")
    return f"the first at seed {cell.seed}, repeat {repeat}, {sample}, theta {text}"
