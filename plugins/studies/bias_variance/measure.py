"""Measures the estimates of one cell against the certified gradient, and times them."""

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

from . import BiasVariance
from .estimates import Estimates


def measure(cell: Cell, session: Session, study: BiasVariance) -> dict[str, Any]:
    """Return one cell's results by column: its status, the reason, and statistics of its estimates.

    A timed cell computes ``timed_calls`` estimates one by one, or all of them on a backend that compiles. Other cells
    compute all estimates together.
    """
    session.compilations.restart()
    program = cell.program()
    theta = program.theta0
    truth = session.references.of(cell)
    problem = session.problem(cell)
    estimates = Estimates(cell, problem, theta)

    timing.reset_peak_memory()
    calls = (cell.repeats if cell.backend.compiles else min(study.timed_calls, cell.repeats)) if cell.timing else 0
    # count only the estimates: the reference may have used the same problem
    problem.reset_usage()
    started = time.perf_counter()
    parts: list[np.ndarray] = []
    clock: timing.Timing | None = None
    if calls:
        parts, clock = timing.timed(
            lambda r: estimates.of(r, r + 1), calls, settle_s=study.settle_s, pause=estimates.pause
        )
    # copied here, because the estimates below, which are not timed, raise the counts further
    usage, n_counted = replace(problem.usage), clock.calls if clock else cell.repeats
    if calls < cell.repeats:
        parts.append(estimates.of(calls, cell.repeats))
    if clock is None:
        usage = replace(problem.usage)
    elapsed = time.perf_counter() - started
    values = np.concatenate(parts)

    result: dict[str, Any] = {
        "status": "ok",
        "reference_method": truth.method,
        "reference_spacing": truth.spacing,
        "model_error": truth.model_error,
        "time_s": clock.median_s if clock else math.nan,
        "time_iqr_s": clock.iqr_s if clock else math.nan,
        "time_samples": list(clock.samples_s) if clock else [],
        "noise_s": noise.seconds(cell.seed, cell.scene.name, cell.samples, program.n_noise) if clock else math.nan,
        "estimates_s": elapsed,
        "compile_s": usage.compile_s,
        "rollouts": usage.rollouts / n_counted,
        "gradients": usage.gradients / n_counted,
        "peak_memory_mb": timing.peak_memory_mb(),
        "device": problem.device,
        "compilations": session.compilations.made,
        "shapes": " ".join(sorted(session.compilations.shapes)),
        "point": theta.tolist(),
        "mean_estimate": values.mean(axis=0).tolist(),
        "reference_gradient": truth.gradient.tolist(),
        "auxiliaries": summarise_diagnostics([estimates.diagnostics[start] for start in sorted(estimates.diagnostics)]),
    }
    if not np.isfinite(truth.batches).all():
        return result | {"status": "nonfinite", "reason": truth.note or "the reference gradient is not finite"}
    unbiased = cell.estimator.declares_unbiased(program)
    summary = asdict(statistics.summarise(values, truth.known(), cell.samples, estimates.sums, unbiased=unbiased))
    surrogate = SURROGATE if program.surrogate and "grad" in cell.estimator.needs else ""
    doubt = cell.estimator.remark(json.loads(result["auxiliaries"])) if result["auxiliaries"] else ""
    remarks = (surrogate, summary.pop("note"), doubt, truth.note)
    result |= {"reason": "; ".join(part for part in remarks if part), **summary}
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        result["status"] = "nonfinite"
        result["reason"] += f"; {locate_first_bad(cell, problem, estimates, int(np.argmax(bad)))}"
    return result


def summarise_diagnostics(diagnostics: list[Auxiliaries]) -> str:
    """Return JSON: each diagnostic's mean, 5, 50 and 95% quantiles and share of exact zeros; empty without diagnostics."""
    table = {}
    for name in diagnostics[0] if diagnostics else ():
        values = np.concatenate([np.ravel(batch[name]) for batch in diagnostics]).astype(np.float64)
        if np.isfinite(values).all():
            low, median, high = np.quantile(values, (0.05, 0.5, 0.95)).tolist()
            table[name] = {
                "mean": float(values.mean()), "low": low, "median": median, "high": high,
                "zero": float((values == 0).mean()),
            }  # fmt: skip
    return json.dumps(table) if table else ""


def locate_first_bad(cell: Cell, problem: Problem, estimates: Estimates, repeat: int) -> str:
    """Return a string with the theta, seed and sample to reproduce an estimate that is not finite.

    The sample is the first one of the repeat whose cost or gradient at theta is not finite. There may be none: an
    estimator can compute an infinite estimate from finite costs and gradients, or evaluate them at another theta.
    """
    theta, before = problem.program.theta0, 0
    sample = "no single sample, costs and gradients are finite"
    for part in estimates.parts(repeat):
        is_bad = ~np.isfinite(problem.value(theta, part))
        if "grad" in cell.backend.provides:
            is_bad |= ~np.isfinite(problem.grad(theta, part)).all(axis=0)
        if is_bad.any():
            sample = f"sample {before + int(np.argmax(is_bad))}"
            break
        before += part.shape[1]
    text = np.array2string(theta, precision=17, threshold=8, separator=", ").replace("\n", "")
    return f"the first at seed {cell.seed}, repeat {repeat}, {sample}, theta {text}"
