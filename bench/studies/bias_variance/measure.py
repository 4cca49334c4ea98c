"""Estimates of one cell against the certified gradient, timed."""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import noise, statistics, timing
from bench.model import SURROGATE, Auxiliaries, Problem
from bench.studies.bias_variance.estimates import Estimates


def measure(cell: Cell, session: Session, timed_calls: int, settle_s: float) -> dict[str, Any]:
    """Measure one cell's estimates.

    Timed cells take ``timed_calls`` of them one by one, all on backends that compile; cells without times take all at
    once. ``settle_s`` is how long calls may be repeated until their times are steady.
    """
    session.compilations.restart()
    program = cell.program()
    theta = program.theta0
    truth = session.references.of(cell)
    problem = session.problem(cell)
    made = Estimates(cell, problem, theta)

    timing.reset_peak_memory()
    calls = (cell.repeats if cell.backend.compiles else min(timed_calls, cell.repeats)) if cell.timing else 0
    # usage covers the timed calls only: the reference may have used the same problem
    problem.reset_usage()
    started = time.perf_counter()
    parts: list[np.ndarray] = []
    clock: timing.Timing | None = None
    if calls:
        parts, clock = timing.timed(lambda r: made.of(r, r + 1), calls, settle_s=settle_s, pause=made.pause)
    # a copy, since the remaining estimates count on
    usage, counted = replace(problem.usage), clock.calls if clock else cell.repeats
    if calls < cell.repeats:
        parts.append(made.of(calls, cell.repeats))
    if clock is None:
        usage = replace(problem.usage)
    spent = time.perf_counter() - started
    estimates = np.concatenate(parts)

    result: dict[str, Any] = {
        "status": "ok",
        "reference_method": truth.method,
        "model_error": truth.model_error,
        "time_s": clock.median_s if clock else math.nan,
        "time_iqr_s": clock.iqr_s if clock else math.nan,
        "time_samples": list(clock.samples_s) if clock else [],
        "noise_s": noise.seconds(cell.seed, cell.scene.name, cell.samples, program.n_noise) if clock else math.nan,
        "estimates_s": spent,
        "compile_s": usage.compile_s,
        "rollouts": usage.rollouts / counted,
        "gradients": usage.gradients / counted,
        "peak_memory_mb": timing.peak_memory_mb(),
        "device": problem.device,
        "compilations": session.compilations.made,
        "shapes": " ".join(sorted(session.compilations.shapes)),
        **made.singles,
        "point": theta.tolist(),
        "mean_estimate": estimates.mean(axis=0).tolist(),
        "reference_gradient": truth.gradient.tolist(),
        "auxiliaries": summarised([made.decided[start] for start in sorted(made.decided)]),
    }
    if not np.isfinite(truth.batches).all():
        return result | {"status": "nonfinite", "reason": "the reference gradient is not finite"}
    unbiased = cell.estimator.declares_unbiased(program)
    summary = asdict(statistics.summarise(estimates, truth.known(), cell.samples, made.sums, unbiased=unbiased))
    surrogate = SURROGATE if program.surrogate and "grad" in cell.estimator.needs else ""
    result |= {"reason": "; ".join(part for part in (surrogate, summary.pop("note"), truth.note) if part), **summary}
    bad = ~np.isfinite(estimates).all(axis=1)
    if bad.any():
        result["status"] = "nonfinite"
        result["reason"] += f"; {first_bad(cell, problem, made, int(np.argmax(bad)))}"
    return result


def summarised(decided: list[Auxiliaries]) -> str:
    """Return as JSON, for each auxiliary, its mean, its 5, 50 and 95% quantiles and the share of exact zeros."""
    table = {}
    for name in decided[0] if decided else ():
        values = np.concatenate([np.ravel(one[name]) for one in decided]).astype(np.float64)
        if np.isfinite(values).all():
            low, median, high = np.quantile(values, (0.05, 0.5, 0.95)).tolist()
            table[name] = {
                "mean": float(values.mean()), "low": low, "median": median, "high": high,
                "zero": float((values == 0).mean()),
            }  # fmt: skip
    return json.dumps(table) if table else ""


def first_bad(cell: Cell, problem: Problem, made: Estimates, repeat: int) -> str:
    """Return where an estimate that is not finite comes from, so that it can be repeated: theta, seed and sample.

    The sample is the first of the repeat whose own cost or gradient is not finite; an estimator may also spoil finite
    ones, or displace theta.
    """
    theta, before = problem.program.theta0, 0
    sample = "no single sample, costs and gradients are finite"
    for part in made.parts(repeat):
        spoilt = ~np.isfinite(problem.value(theta, part))
        if "grad" in cell.backend.provides:
            spoilt |= ~np.isfinite(problem.grad(theta, part)).all(axis=0)
        if spoilt.any():
            sample = f"sample {before + int(np.argmax(spoilt))}"
            break
        before += part.shape[1]
    text = np.array2string(theta, precision=17, threshold=8, separator=", ").replace("\n", "")
    return f"the first at seed {cell.seed}, repeat {repeat}, {sample}, theta {text}"
