"""Runs one search: an optimizer chooses points, problem and estimator evaluate them, and the objective scores its path."""

from __future__ import annotations

import math
import time
import timeit
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import noise
from bench.model import IID, Answer, Design, Estimator, KnownOptimum, Optimizer, Problem, Rollout, zeroth_order
from bench.model.blocks import OfColumns
from bench.model.program import OWN
from bench.run.shared import Shared

from .. import against_reference, ratio
from . import Optimise, search_parts
from .solve import solve

PATH = ("iteration", "cost", "rollouts", "gradients", "s")
"""What is recorded along a path."""
MAX_POINTS = 300
"""Most points of a path to store, about; they are denser in early iterations."""


def objective(problem: Problem, theta: np.ndarray, scored: np.ndarray) -> float:
    """Return the mean cost at ``theta (d,)`` over some noise ``(n_w, M)``. Its rollouts are not counted."""
    before = problem.usage.rollouts
    cost = float(problem.value(theta, scored).mean())
    problem.usage.rollouts = before
    return cost


def mean_costs(problem: Problem, points: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the mean costs ``(B,)`` of points ``(d, B)`` over the same noise ``(n_w, M)``."""
    count = points.shape[1]
    costs = problem.value(np.repeat(points, w.shape[1], axis=1), np.tile(w, (1, count)))
    return costs.reshape(count, -1).mean(axis=1)


def estimates(problem: Problem, estimator: Estimator, points: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return an estimator's gradients ``(d, B)`` at points, all from the same noise ``(1, N, n_w)``."""
    return np.stack([estimator.estimate(problem, point, w)[0] for point in points.T], axis=1)


def advance(
    optimizer: Optimizer,
    state: dict[str, Any],
    normal: np.ndarray,
    costs: OfColumns,
    gradients: OfColumns,
) -> dict[str, Any]:
    """Return the optimizer's state after one more iteration: the points it asks for, and what it requires there."""
    points = optimizer.ask(state, normal)
    required = optimizer.required_fields(state)
    known = {"value": costs, "gradient": gradients}
    return optimizer.tell(state, points, Answer(**{name: known[name](points) for name in known if name in required}))


def measure(cell: Cell, session: Session, settings: Optimise) -> dict[str, Any]:
    """Search until the budget is spent or the cost has diverged; return the cell's results by column."""
    problem = session.problem(cell)
    optimum, how = known_optimum(cell, problem, session)
    theta0 = problem.program.theta0
    quality = gradient_quality(cell, problem, session)
    path, theta, stopped = follow_path(cell, problem, theta0, settings)
    iterations, final, rollouts, gradients, seconds = path[-1]
    cost, is_lost = [point[1] for point in path], stopped == "diverged"
    lost = f"the cost left {settings.limit:g} (|J0| + 1) or is not finite"
    start, stored = cost[0], [path[i] for i in stored_indices(cost)]
    score = float(np.clip((start - final) / (start - optimum), 0.0, 1.0)) if start > optimum else np.nan
    return {
        **quality,
        "status": "diverged" if is_lost else "ok",
        "reason": "; ".join(filter(None, (lost * is_lost, quality.get("reason", "")))),
        "stopped": stopped,
        "scene_class": scene_class(cell, problem),
        "iterations": iterations,
        "rollouts": rollouts,
        "gradients": gradients,
        "gradient_ratio": gradient_ratio(problem, cell) if cell.timing and cell.parts["estimator"] else np.nan,
        "search_s": seconds,
        "start_cost": start,
        "final_cost": final,
        "best_cost": float(np.nanmin(cost)),
        "optimum": optimum,
        "optimum_status": how,
        "score": 0.0 if is_lost and not np.isfinite(score) else score,
        **{f"path_{name}": list(values) for name, values in zip(PATH, zip(*stored, strict=True), strict=True)},
        "theta": theta.tolist(),
    }


def stored_indices(cost: Sequence[float]) -> np.ndarray:
    """Return the indices of about :data:`MAX_POINTS` points of a path to store: log-spaced, with the last and lowest cost."""
    if len(cost) <= MAX_POINTS:
        return np.arange(len(cost))
    spaced = np.unique(np.round(np.geomspace(1, len(cost), MAX_POINTS)).astype(int)) - 1
    return np.unique(np.append(spaced, np.nanargmin(cost)))


def follow_path(
    cell: Cell, problem: Problem, theta0: np.ndarray, settings: Optimise
) -> tuple[list[tuple[float, ...]], np.ndarray, str]:
    """Iterate until the budget is spent or the cost has diverged; return the path, its last theta, and which of both.

    The path has the numbers of :data:`PATH` of each iteration.
    """
    (optimizer, estimator), usage = search_parts(cell), problem.usage
    design = cell.design(problem.program)
    still = np.zeros((problem.program.n_noise, 1))

    def step(state: dict[str, Any], iteration: int) -> dict[str, Any]:
        def draw(count: int, width: int, what: str, design: Design = IID) -> np.ndarray:
            return noise.draw(cell.seed, cell.scene.name, 1, count, width, f"optimise: {what} {iteration}", design)

        return advance(
            optimizer,
            state,
            draw(optimizer.draws(problem.dim), problem.dim, "points")[0].T,
            lambda points: mean_costs(problem, points, still),
            lambda points: estimates(problem, estimator, points, draw(cell.samples, len(still), "samples", design)),
        )

    state = optimizer.start(theta0)
    step(state, 1)  # compiles, untimed
    path: list[tuple[float, ...]] = []
    usage.rollouts = usage.gradients = 0
    most = settings.iterations if settings.iterations is not None else math.inf
    iteration, seconds = 0, 0.0
    while True:
        cost = objective(problem, state["theta"], still)
        path.append((iteration, cost, usage.rollouts, usage.gradients, seconds))
        if not np.isfinite(cost) or abs(cost) > settings.limit * (abs(path[0][1]) + 1.0):
            return path, state["theta"], "diverged"
        if usage.rollouts + settings.gradient_cost * usage.gradients >= settings.budget or iteration >= most:
            return path, state["theta"], "budget"
        iteration += 1
        started = time.perf_counter()
        state = step(state, iteration)
        seconds += time.perf_counter() - started


# ------------------------------------------------------------------------------------------------ the objective


def known_optimum(cell: Cell, problem: Problem, session: Session) -> tuple[float, str]:
    """Return J* and its source: the scene, or Newton's method, whose result is stored in a file; NaN if unknown."""
    if isinstance(cell.scene, KnownOptimum) and cell.decision == OWN:
        known = cell.scene.optimum(cell.contact, cell.integrator)
        if known is not None:
            return known
    # Newton's method computes the optimum in up to 1000 dimensions
    if problem.dim > 1000 or not problem.program.continuous or "grad" not in cell.backend.provides:
        return np.nan, "unknown"
    found = stored_in(session, f"optimum_{cell.program_key}", lambda: _newton(problem))
    return found["cost"], found["how"]


def _newton(problem: Problem) -> dict[str, Any]:
    solution = solve(problem)
    if not np.isfinite(solution.cost):
        return {"cost": np.nan, "how": "unknown"}
    found = "local optimum by Newton's method" if solution.certified else "lowest cost found"
    saddle = ", from a saddle at the start" if solution.starts_at_saddle else ""
    digits = f"|gradient| {solution.gradient:.0e}, least curvature {solution.curvature:.1g}"
    return {"cost": solution.cost, "how": f"{found}, {digits}{saddle}"}


def stored_in(session: Session, name: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return a result that cells share, computed and stored at first use, see :class:`bench.run.shared.Shared`."""
    shared = Shared(session.experiment)
    found = shared.load(name)
    if found is None:
        found = compute()
        shared.save(name, found)
    return found


def scene_class(cell: Cell, problem: Problem) -> str:
    """Return the class of a problem, by the reason that its gradients are difficult.

    A problem without contacts whose gradients vary more than its zeroth-order terms is chaotic if it has time steps,
    else stiff.
    """
    program = problem.program
    if cell.decision.names or cell.scene.identifies:
        return "identification"
    if not program.continuous:
        return "discontinuous"
    if isinstance(program, Rollout) and program.scene.n_contacts:
        return "stiff"
    drawn = noise.draw(0, cell.scene.name, 1, 128, program.n_noise, "optimise: class")
    with np.errstate(all="ignore"):
        first = problem.grad(program.theta0, drawn[0].T).var(axis=1).sum()
        zeroth = zeroth_order(problem, program.theta0, drawn)[0].var(axis=0).sum()
    return "smooth" if first < zeroth else "chaotic" if isinstance(program, Rollout) else "stiff"


_ratios: dict[tuple[str, str], float] = {}


def gradient_ratio(problem: Problem, cell: Cell) -> float:
    """Return the time of a batch of gradients over the time of a batch of costs, each the fastest of some calls."""
    key = (cell.program_key, cell.backend.name)
    if key not in _ratios:
        theta, w = problem.program.theta0, noise.draw(0, "ratio", 1, 128, problem.program.n_noise, "optimise: ratio")
        _ratios[key] = fastest(problem.grad, theta, w[0].T) / fastest(problem.value, theta, w[0].T)
    return _ratios[key]


def fastest(function: Callable[[np.ndarray, np.ndarray], Any], theta: np.ndarray, w: np.ndarray) -> float:
    """Return the least time [s] of five calls after a first one that compiles."""
    function(theta, w)
    return min(timeit.repeat(lambda: function(theta, w), number=1, repeat=5))


# ---------------------------------------------------------------------------------------------- gradient quality

_qualities: dict[tuple[Any, ...], dict[str, Any]] = {}


def gradient_quality(cell: Cell, problem: Problem, session: Session) -> dict[str, Any]:
    """Return the columns of the estimator's gradients at theta0 against the certified reference, and a reason; empty without one."""
    estimator = cell.parts["estimator"]
    if cell.budget is None or not isinstance(estimator, Estimator):
        return {}
    key = (cell.reference_key, cell.backend, estimator, cell.samples, cell.repeats)
    if key not in _qualities:
        counts = (max(cell.repeats, 2), cell.samples, problem.program.n_noise)
        drawn = noise.draw(0, cell.scene.name, *counts, "optimise: quality", cell.design(problem.program))
        estimates = estimator.estimate(problem, problem.program.theta0, drawn)
        found = against_reference(problem, estimator, session.references.of(cell), estimates, cell.samples)
        known = {name: found.get(name, math.nan) for name in ("rmse_rel", "cosine")}
        known["bias_share"] = ratio(found.get("bias", math.nan), found.get("rmse", math.nan)) ** 2
        _qualities[key] = {f"quality_{name}": value for name, value in known.items()} | {
            name: found[name] for name in ("reason", "reference_method", "reference_spacing")
        }
    return _qualities[key]
