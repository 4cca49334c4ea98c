"""What all methods of a problem share: its optimum, and ten thetas of one path with the best gradients there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from bench.plugins.studies.optimise import search_parts
from bench.plugins.studies.optimise.measure import known_optimum, objective, stored_in
from scipy.optimize import minimize

from bench.errors import Unsupported
from bench.experiment.cell import Cell
from bench.experiment.keys import fingerprint, hashed
from bench.experiment.session import Session
from bench.measure import noise
from bench.model import Estimator, Optimizer, Problem, best_gradient, zeroth_order

from .search import Method, Task, run_searches, tune, unit_rate, with_rate

POINTS = 10
"""Number of thetas at which errors are measured."""
SCORED = 256
"""Rollouts of the objective of a discontinuous cost: the mean over this fixed noise."""
PRECISE = 1024
"""Samples of a zeroth-order gradient during the searches of a discontinuous cost."""
EXACT = 1 << 15
"""Samples of the zeroth-order gradient that estimates are compared with on a discontinuous cost."""
SEARCHED = 4000
"""Most costs of the search for the optimum of a discontinuous cost."""


class BestGradient(Estimator):
    """The best gradient available: without noise for a continuous cost, else the mean of costs times scores."""

    name = ""  # not a plugin

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the gradient of the scored objective, ``(R, d)``."""
        return best_gradient(problem, theta, noise)


@dataclass(frozen=True)
class Ground:
    """The optimum of a problem, and the thetas of its common path with the gradients of the objective there."""

    start: float
    optimum: float
    how: str
    """The source of the optimum."""
    thetas: np.ndarray
    """``(POINTS, d)``, or empty without a gradient method."""
    gradients: np.ndarray
    """``(POINTS, d)``."""
    variances: np.ndarray
    """Squared standard error of each gradient, ``(POINTS,)``."""


def scored_noise(problem: Problem, scene: str) -> np.ndarray:
    """Return the noise ``(n_w, M)`` of the objective: none but a scene's own for a continuous cost, else a fixed sample."""
    width = problem.program.n_noise
    if problem.program.continuous:
        return problem.program.noise_free
    return noise.draw(0, scene, 1, SCORED, width, "dose_response: scores")[0].T


def ground_of(cell: Cell, problem: Problem, session: Session, settings: Any) -> Ground:
    """Return the problem's optimum and common path, from a file beside the references or computed and stored."""
    optimizer, _ = search_parts(cell)
    key = hashed(cell.program_key, fingerprint(cell.study), fingerprint(optimizer), fingerprint(cell.backend))
    found = stored_in(session, f"path_{key}", lambda: _compute(cell, problem, session, settings, optimizer))
    arrays = {name: np.array(found[name]) for name in ("thetas", "gradients", "variances")}
    return Ground(**found | arrays)


def _compute(cell: Cell, problem: Problem, session: Session, settings: Any, optimizer: Optimizer) -> dict[str, Any]:
    scored = scored_noise(problem, cell.scene.name)
    theta0 = problem.program.theta0
    start = objective(problem, theta0, scored)
    optimum, how = _optimum(cell, problem, session, scored)
    if not start - optimum > 1e-9 * (abs(start) + abs(optimum)):
        raise Unsupported(f"the cost at the start, {start:g}, is not above the lowest cost known, {optimum:g} ({how})")
    found = {"start": start, "optimum": optimum, "how": how, "thetas": [], "gradients": [], "variances": []}
    if "gradient" not in optimizer.needs:
        return found
    task = Task(cell.scene.name, scored, start, optimum, settings.iterations)
    is_random = not problem.program.continuous
    method = Method(optimizer, BestGradient(), PRECISE if is_random else 1, is_random)
    w = noise.draw(0, cell.scene.name, 1, method.samples, problem.program.n_noise, "dose_response: first")
    scale = unit_rate(optimizer, BestGradient().estimate(problem, theta0, w)[0])
    tuning = tune(problem, task, method, [0], [scale * r for r in settings.grid()], settings.widenings)
    best = with_rate(method, tuning.rates[tuning.best[-1]])
    (search,) = run_searches(problem, task, [best], [0], keep=True)
    lowest = int(np.argmin([objective(problem, t, scored) if np.isfinite(t).all() else np.inf for t in search.thetas]))
    # evenly spaced updates from the start to the last target, or to the lowest cost; the end itself is left out,
    # since the gradient may vanish there
    places = np.linspace(0, max(lowest - 1, 0), POINTS).round().astype(int)
    thetas = np.array([search.thetas[i] for i in places])
    gradients, variances = _gradients(problem, cell.scene.name, thetas)
    lists = {"thetas": thetas.tolist(), "gradients": gradients.tolist(), "variances": variances.tolist()}
    return found | lists


def _gradients(problem: Problem, scene: str, thetas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    width = problem.program.n_noise
    if problem.program.continuous:
        still = problem.program.noise_free
        count = still.shape[1]
        per_draw = problem.grad(np.repeat(thetas.T, count, axis=1), np.tile(still, (1, len(thetas))))
        return per_draw.reshape(problem.dim, len(thetas), count).mean(axis=2).T, np.zeros(len(thetas))
    w = noise.draw(1, scene, 1, EXACT, width, "dose_response: exact")
    terms = [zeroth_order(problem, theta, w)[0] for theta in thetas]
    return np.array([t.mean(axis=0) for t in terms]), np.array([t.var(axis=0, ddof=1).sum() / EXACT for t in terms])


def _optimum(cell: Cell, problem: Problem, session: Session, scored: np.ndarray) -> tuple[float, str]:
    """Return the lowest cost of the scored objective and its source."""
    if problem.program.continuous and not problem.program.exogenous:
        optimum, how = known_optimum(cell, problem, session)
        if np.isfinite(optimum):
            return optimum, how
    theta0 = problem.program.theta0
    w = noise.draw(0, cell.scene.name, 1, PRECISE, problem.program.n_noise, "dose_response: optimum")

    def cost(theta: np.ndarray) -> float:
        value = objective(problem, theta, scored)
        return value if np.isfinite(value) else 1e300

    def slope(theta: np.ndarray) -> np.ndarray:
        gradient = BestGradient().estimate(problem, theta, w)[0]
        return np.where(np.isfinite(gradient), gradient, 0.0)

    with np.errstate(all="ignore"):
        near = minimize(cost, theta0, jac=slope, method="L-BFGS-B", options={"maxiter": 200})
        starts = [near.x] if problem.program.continuous else [theta0, near.x]
        starts = starts if theta0.size <= 100 else []
        ends = [minimize(cost, x, method="Powell", options={"maxfev": SEARCHED}) for x in starts]
    return float(min([near.fun, *(end.fun for end in ends)])), "lowest cost found by L-BFGS and Powell's method"
