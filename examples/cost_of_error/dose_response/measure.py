"""Measures one method on one problem: updates to each target at its best rate, and its gradients' errors on a common path."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from bench.plugins.studies.optimise import search_parts
from bench.plugins.studies.optimise.measure import fastest, scene_class

from bench.errors import Unsupported
from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import noise
from bench.measure.statistics import Truth, summarise
from bench.model import IID, Problem

from . import DoseResponse
from .ground import Ground, ground_of, scored_noise
from .search import (
    MOST_NUMBERS,
    Method,
    Task,
    run_searches,
    tune,
    unit_rate,
    with_rate,
)

HYPOTHESES = Path(__file__).parents[1] / "hypotheses.md"
"""The hypotheses that were written before the first run."""
TUNING_SEED = 10_000
"""First seed of the searches that choose the rate."""
TIMED = 256
"""Columns of a timed call."""


def measure(cell: Cell, session: Session, settings: DoseResponse) -> dict[str, Any]:
    """Return one cell's results by column."""
    problem = session.problem(cell)
    with np.errstate(all="ignore"):
        ground = ground_of(cell, problem, session, settings)
        scored = scored_noise(problem, cell.scene.name)
        task = Task(cell.scene.name, scored, ground.start, ground.optimum, settings.iterations)
        method, first = _method(cell, problem)
        n_tuning, n_runs = (settings.tuning_seeds, settings.seeds) if method.is_random else (1, 1)
        seeds, scale = 100_000 * cell.seed + np.arange(n_runs), unit_rate(method.optimizer, first)
        tuning = tune(
            problem,
            task,
            method,
            (100_000 * cell.seed + TUNING_SEED + np.arange(n_tuning)).tolist(),
            [scale * rate for rate in settings.grid()],
            settings.widenings,
        )
        best = list(dict.fromkeys(tuning.best))
        methods = [with_rate(method, tuning.rates[place]) for place in best for _ in seeds]
        results = run_searches(problem, task, methods, seeds.tolist() * len(best))
        searches = {place: results[i * n_runs : (i + 1) * n_runs] for i, place in enumerate(best)}
        errors = errors_on_path(cell, problem, method, ground) if method.estimator is not None else {}
    updates = [search.updates[k] for k, place in enumerate(tuning.best) for search in searches[place]]
    return {
        "status": "ok",
        "reason": "",
        "scene_class": scene_class(cell, problem),
        "start_cost": ground.start,
        "optimum": ground.optimum,
        "optimum_status": ground.how,
        "budget": settings.iterations,
        "runs": n_runs,
        "updates": _finite(updates),
        "best_rates": [tuning.rates[place] for place in tuning.best],
        "is_inside": [float(inside) for inside in tuning.is_inside],
        "rates": tuning.rates,
        "rate_updates": _finite(tuning.updates.ravel()),
        "tuning_rollouts": tuning.rollouts,
        "tuning_gradients": tuning.gradients,
        "rollouts_per_update": float(np.mean([s.rollouts for s in results])),
        "gradients_per_update": float(np.mean([s.gradients for s in results])),
        "lowest": float(np.median([s.lowest for s in searches[tuning.best[-1]]])),
        "hypotheses": hypotheses_hash(),
        **_times(cell, problem),
        **errors,
    }


def _finite(values: Iterable[float]) -> list[float]:
    """Return values with NaN instead of infinities."""
    return [value if math.isfinite(value) else math.nan for value in values]


def hypotheses_hash() -> str:
    """Return the first 12 digits of the SHA-256 of the file of hypotheses; empty if the file is absent."""
    return hashlib.sha256(HYPOTHESES.read_bytes()).hexdigest()[:12] if HYPOTHESES.exists() else ""


def _method(cell: Cell, problem: Problem) -> tuple[Method, np.ndarray | None]:
    """Return the method of a cell, and a gradient at the start for an optimizer that uses gradients."""
    optimizer, estimator = search_parts(cell)
    if estimator is None:
        return Method(optimizer, None, 1), None
    if cell.design(problem.program) != IID:
        raise Unsupported("this study draws independent samples only: draws=iid mirrored=false")
    w = noise.draw(cell.seed, cell.scene.name, 4, cell.samples, problem.program.n_noise, "dose_response: first")
    first = estimator.estimate(problem, problem.program.theta0, w)
    if not np.isfinite(first).all():
        raise Unsupported("the gradient at the start is not finite")
    is_random = not (first == first[0]).all()
    return Method(optimizer, estimator, cell.samples, is_random), np.abs(first).mean(axis=0)


def errors_on_path(cell: Cell, problem: Problem, method: Method, ground: Ground) -> dict[str, Any]:
    """Return the relative error of the estimates on the common path: medians over its thetas, and the error at each.

    The noise of the estimates and of the best gradient is subtracted from the squared bias, and the latter from the
    squared error.
    """
    assert method.estimator is not None
    lines = [
        compare(_estimates(cell, problem, method, theta), gradient, variance)
        for theta, gradient, variance in zip(ground.thetas, ground.gradients, ground.variances, strict=True)
    ]
    known = [line for line in lines if math.isfinite(line["error"])]
    medians = {name: float(np.median([line[name] for line in known])) for name in lines[0]} if known else {}
    return medians | {"error_start": lines[0]["error"], "path_errors": [line["error"] for line in lines]}


def _estimates(cell: Cell, problem: Problem, method: Method, theta: np.ndarray) -> np.ndarray:
    """Return independent estimates ``(R, d)`` at a theta, computed in parts that fit in memory."""
    assert method.estimator is not None
    repeats, width = cell.repeats if method.is_random else 2, problem.program.n_noise
    w = noise.draw(cell.seed, cell.scene.name, repeats, cell.samples, width, "dose_response: errors")
    size = max(1, MOST_NUMBERS // (cell.samples * max(problem.dim, width)))
    parts = [method.estimator.estimate(problem, theta, w[i : i + size]) for i in range(0, repeats, size)]
    return np.concatenate(parts)


def compare(estimates: np.ndarray, gradient: np.ndarray, variance: float) -> dict[str, float]:
    """Return relative error, bias and spread, cosine, and share of right signs of estimates ``(R, d)``.

    ``gradient (d,)`` has the squared standard error ``variance``. Error, bias and spread are relative to its norm and
    add up in squares. All are NaN if an estimate is not finite or the gradient is not known to a half.
    """
    norm2 = float(gradient @ gradient) - variance
    names = ("error", "bias", "spread", "cosine", "sign_agreement")
    if not np.isfinite(estimates).all() or not norm2 > 4 * variance or not norm2 > 0:
        return dict.fromkeys(names, math.nan)
    found = summarise(estimates, Truth.exact(gradient, math.sqrt(variance)), 1)
    parts = np.array([found.rmse, found.bias, math.sqrt(found.variance)]) / math.sqrt(norm2)
    signs = (np.sign(estimates) == np.sign(gradient)).mean()
    return dict(zip(names, [*parts.tolist(), found.cosine, float(signs)], strict=True))


def _times(cell: Cell, problem: Problem) -> dict[str, float]:
    """Return the seconds of a rollout and of a gradient in a batch, each from the fastest of some calls."""
    theta = problem.program.theta0
    w = noise.draw(0, cell.scene.name, 1, TIMED, problem.program.n_noise, "dose_response: times")[0].T
    functions = {"rollout_s": problem.value} | ({"gradient_s": problem.grad} if "grad" in cell.backend.provides else {})
    return {name: fastest(function, theta, w) / TIMED for name, function in functions.items()}
