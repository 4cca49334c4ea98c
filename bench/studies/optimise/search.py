"""Runs one search: an optimizer chooses points, problem and estimator evaluate them, and the objective scores its path."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.experiment.cell import Cell
from bench.experiment.session import Session
from bench.measure import noise
from bench.measure.solve import solve
from bench.model import Answer, Estimator, KnownOptimum, Optimizer, Problem, Rollout
from bench.model.program import OWN
from bench.run.files import make_directory, write_whole

MAX_POINTS = 300
"""Most points of a path to store, about; they are denser in early iterations."""
MAX_NEWTON_DIM = 1000
"""Largest dimension of theta for which Newton's method computes the optimum."""

Settings = Any
"""An ``Optimise`` study: its parameters are the settings. Its module imports this module, so its type cannot be named."""


class ScaledNoiseProblem(Problem):
    """A problem with its noise multiplied by a factor, on the same compiled program."""

    def __init__(self, inner: Problem, factor: float) -> None:
        super().__init__(inner.program)
        self._inner, self._factor = inner, factor
        self.usage = inner.usage

    @property
    def sigma(self) -> float:
        """Standard deviation of the scaled noise."""
        return self._factor * self._inner.sigma

    def value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return costs ``(B,)`` under the scaled noise."""
        return self._inner.value(theta, self._factor * w)

    def grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return gradients ``(d, B)`` under the scaled noise."""
        return self._inner.grad(theta, self._factor * w)

    def score(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return scores ``(d, B)`` under the scaled noise. They are linear in w and inverse to the noise's variance."""
        return self._inner.score(theta, self._factor * w) / self._factor**2

    @property
    def gives_jacobians(self) -> bool:
        """Whether the problem defines :meth:`jacobians`."""
        return self._inner.gives_jacobians

    def jacobians(self, theta: np.ndarray, w: np.ndarray) -> Any:
        """Return the step Jacobians under the scaled noise."""
        return self._inner.jacobians(theta, self._factor * w)

    def trajectory(self, theta: np.ndarray, w: np.ndarray) -> Any:
        """Return the states under the scaled noise."""
        return self._inner.trajectory(theta, self._factor * w)

    _value = _grad = _score = None  # type: ignore[assignment]


@dataclass
class SearchPath:
    """The path of a search. Each list has one entry per iteration: cost, and counts and time [s] up to that iteration."""

    iteration: list[int] = field(default_factory=list)
    cost: list[float] = field(default_factory=list)
    rollouts: list[int] = field(default_factory=list)
    gradients: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def stored_indices(self) -> np.ndarray:
        """Return the indices of about :data:`MAX_POINTS` entries to store: log-spaced, with the last and lowest cost."""
        count = len(self.iteration)
        if count <= MAX_POINTS:
            return np.arange(count)
        spaced = np.unique(np.round(np.geomspace(1, count, MAX_POINTS)).astype(int)) - 1
        return np.unique(np.append(spaced, np.nanargmin(self.cost)))


class OptimizerRun:
    """One search on one problem: computes single iterations, and the objective at a point."""

    def __init__(self, cell: Cell, problem: Problem, settings: Settings) -> None:
        self.cell, self.problem, self.settings = cell, problem, settings
        optimizer, estimator = cell.parts["optimizer"], cell.parts["estimator"]
        assert isinstance(optimizer, Optimizer)
        assert estimator is None or isinstance(estimator, Estimator)
        self.optimizer, self.estimator = optimizer, estimator
        width = problem.program.n_noise
        self._still = np.zeros((width, 1))
        drawn = noise.draw(cell.seed, cell.scene.name, 1, settings.evaluations, width, "optimise: scores")[0].T
        self._scored = self._still if settings.scored == "plain" else drawn

    def objective(self, theta: np.ndarray) -> float:
        """Return the objective at ``theta (d,)``, with noise that no iteration uses. Its rollouts are not counted."""
        return objective(self.problem, theta, self._scored)

    def step(self, state: dict[str, Any], iteration: int) -> dict[str, Any]:
        """Return the optimizer's state after one more iteration, whose number is ``iteration``, from 1."""
        dim = self.problem.dim
        normal = noise.draw(
            self.cell.seed, self.cell.scene.name, 1, self.optimizer.draws(dim), dim, f"optimise: points {iteration}"
        )[0].T
        return advance(
            self.optimizer, state, normal, lambda points: self._values(points, iteration),
            lambda points: self._gradients(points, iteration),
        )  # fmt: skip

    def _noise(self, iteration: int) -> np.ndarray:
        width = self.problem.program.n_noise
        return noise.draw(
            self.cell.seed, self.cell.scene.name, 1, self.cell.samples, width, f"optimise: samples {iteration}"
        )

    def _values(self, points: np.ndarray, iteration: int) -> np.ndarray:
        """Return the costs ``(B,)`` of points ``(d, B)``: at w = 0, or means over samples for a smoothed objective."""
        w = self._still if self.settings.scored == "plain" else self._noise(iteration)[0].T
        return mean_costs(self.problem, points, w)

    def _gradients(self, points: np.ndarray, iteration: int) -> np.ndarray:
        problem = self.problem
        if self.settings.sigma_decay:
            problem = ScaledNoiseProblem(problem, iteration**-self.settings.sigma_decay)
        return estimates(problem, self.estimator, points, self._noise(iteration))


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
    return np.asarray(costs.reshape(count, -1).mean(axis=1))


def estimates(problem: Problem, estimator: Estimator | None, points: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return an estimator's gradients ``(d, B)`` at points, all from the same noise ``(1, N, n_w)``."""
    assert estimator is not None
    return np.stack([estimator.estimate(problem, point, w)[0] for point in points.T], axis=1)


def advance(
    optimizer: Optimizer,
    state: dict[str, Any],
    normal: np.ndarray,
    costs: Callable[[np.ndarray], np.ndarray],
    gradients: Callable[[np.ndarray], np.ndarray],
) -> dict[str, Any]:
    """Return the optimizer's state after one more iteration: the points it asks for, and what it requires there."""
    points = optimizer.ask(state, normal)
    required = optimizer.required_fields(state)
    value = costs(points) if "value" in required else None
    gradient = gradients(points) if "gradient" in required else None
    return optimizer.tell(state, points, Answer(value, gradient))


def run_search(cell: Cell, session: Session, settings: Settings) -> dict[str, Any]:
    """Search until the budget, the target, a plateau or divergence; return the cell's results by column."""
    problem = session.problem(cell)
    optimum, how = known_optimum(cell, problem, session, settings)
    search = OptimizerRun(cell, problem, settings)
    theta0 = np.array(problem.program.theta0, dtype=np.float64)
    start_quality = gradient_quality(search, theta0, settings) if settings.quality != "none" else None
    state = search.optimizer.start(theta0)
    search.step(state, 1)  # compiles, untimed
    path, stopped, thetas = follow_path(search, state, settings)
    stored = path.stored_indices()
    start, final, best = path.cost[0], path.cost[-1], float(np.nanmin(path.cost))
    qualities = {} if start_quality is None else {0: start_quality}
    if settings.quality == "path" and stopped != "diverged":
        for index in sorted({round(share * (len(thetas) - 1)) for share in QUALITY_SHARES} - {0}):
            quality = gradient_quality(search, thetas[index], settings)
            if quality is not None:
                qualities[path.iteration[index]] = quality
    result = {
        "status": "diverged" if stopped == "diverged" else "ok",
        "reason": f"the cost left {settings.limit:g} (|J0| + 1) or is not finite" if stopped == "diverged" else "",
        "stopped": stopped,
        "scene_class": scene_class(cell, problem),
        "iterations": path.iteration[-1],
        "rollouts": path.rollouts[-1],
        "gradients": path.gradients[-1],
        "gradient_ratio": gradient_ratio(problem, cell) if cell.timing and search.estimator is not None else np.nan,
        "search_s": path.seconds[-1],
        "start_cost": start,
        "final_cost": final,
        "best_cost": best,
        "optimum": optimum,
        "optimum_status": how,
        "score": float(np.clip((start - final) / (start - optimum), 0.0, 1.0)) if start > optimum else np.nan,
        **{f"path_{name}": np.asarray(getattr(path, name))[stored].tolist() for name in PATH_COLUMNS},
        "path_s": np.asarray(path.seconds)[stored].tolist(),
        "theta": thetas[-1].tolist(),
    }
    if start_quality is not None:
        result |= {f"quality_{name}": value for name, value in start_quality.items()}
        result["path_quality_iteration"] = list(qualities)
        for name in ("rmse_rel", "cosine"):
            result[f"path_quality_{name}"] = [quality[name] for quality in qualities.values()]
    if not np.isfinite(result["score"]) and stopped == "diverged":
        result["score"] = 0.0
    return result


QUALITY_SHARES = (0.25, 0.5, 0.75, 1.0)
"""Shares of a path's iterations at which the gradient's quality is measured, in addition to the start."""
PATH_COLUMNS = ("iteration", "cost", "rollouts", "gradients")


def follow_path(
    search: OptimizerRun, state: dict[str, Any], settings: Settings
) -> tuple[SearchPath, str, list[np.ndarray]]:
    """Iterate until a stopping rule applies; return the path, the name of the rule, and theta ``(d,)`` at each point."""
    problem, path, thetas = search.problem, SearchPath(), []
    problem.usage.rollouts = problem.usage.gradients = 0
    spent_s, best, waited, stopped = 0.0, np.inf, 0, ""
    iteration = 0
    while True:
        cost = search.objective(state["theta"])
        path.iteration.append(iteration)
        path.cost.append(cost)
        path.rollouts.append(problem.usage.rollouts)
        path.gradients.append(problem.usage.gradients)
        path.seconds.append(spent_s)
        thetas.append(np.array(state["theta"]))
        waited = 0 if cost < best - 1e-12 * abs(best) or not np.isfinite(best) else waited + 1
        best = min(best, cost)
        spent = problem.usage.rollouts + settings.gradient_cost * problem.usage.gradients
        if not np.isfinite(cost) or abs(cost) > settings.limit * (abs(path.cost[0]) + 1.0):
            stopped = "diverged"
        elif settings.target is not None and cost <= settings.target:
            stopped = "target"
        elif spent >= settings.budget or (settings.iterations is not None and iteration >= settings.iterations):
            stopped = "budget"
        elif settings.patience is not None and waited >= settings.patience:
            stopped = "plateau"
        if stopped:
            return path, stopped, thetas
        iteration += 1
        started = time.perf_counter()
        state = search.step(state, iteration)
        spent_s += time.perf_counter() - started


# ------------------------------------------------------------------------------------------------ the objective


def known_optimum(cell: Cell, problem: Problem, session: Session, settings: Settings) -> tuple[float, str]:
    """Return J* and its source: the scene, or Newton's method, whose result is stored in a file; NaN if unknown."""
    if settings.scored != "plain":
        return np.nan, "unknown: the objective is smoothed"
    if isinstance(cell.scene, KnownOptimum) and cell.decision == OWN:
        known = cell.scene.optimum(cell.contact, cell.integrator)
        if known is not None:
            return known
    if problem.dim > MAX_NEWTON_DIM or not problem.program.continuous or "grad" not in cell.backend.provides:
        return np.nan, "unknown"
    path = session.experiment.results_dir / "references" / f"optimum_{cell.program_key}.json"
    try:
        stored = json.loads(path.read_text())
        return float(stored["cost"]), str(stored["how"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    solution = solve(problem)
    if not np.isfinite(solution.cost):
        return np.nan, "unknown"
    digits = f"|gradient| {solution.gradient:.0e}, least curvature {solution.curvature:.1g}"
    how = f"local optimum by Newton's method, {digits}" if solution.certified else f"lowest cost found, {digits}"
    if solution.starts_at_saddle:
        how += ", from a saddle at the start"
    make_directory(path.parent)
    write_whole(path, json.dumps({"cost": solution.cost, "how": how}).encode())
    return solution.cost, how


_classes: dict[str, str] = {}


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
    if cell.program_key not in _classes:
        w = noise.draw(0, cell.scene.name, 1, 128, program.n_noise, "optimise: class")[0].T
        with np.errstate(all="ignore"):
            first = problem.grad(program.theta0, w).var(axis=1).sum()
            cost = problem.value(program.theta0, w) - problem.value(program.theta0, 0.0 * w[:, :1])
            zeroth = (cost * problem.score(program.theta0, w)).var(axis=1).sum()
        _classes[cell.program_key] = (
            "smooth" if first < zeroth else "chaotic" if isinstance(program, Rollout) else "stiff"
        )
    return _classes[cell.program_key]


_ratios: dict[tuple[str, str], float] = {}


def gradient_ratio(problem: Problem, cell: Cell) -> float:
    """Return the time of a batch of gradients over the time of a batch of costs, each the fastest of some calls."""
    key = (cell.program_key, cell.backend.name)
    if key not in _ratios:
        theta, w = problem.program.theta0, noise.draw(0, "ratio", 1, 128, problem.program.n_noise, "optimise: ratio")
        _ratios[key] = fastest(problem.grad, theta, w[0].T) / fastest(problem.value, theta, w[0].T)
    return _ratios[key]


def fastest(
    function: Callable[[np.ndarray, np.ndarray], Any], theta: np.ndarray, w: np.ndarray, calls: int = 5
) -> float:
    """Return the least time [s] of some calls after a first one that compiles."""
    function(theta, w)
    times = []
    for _ in range(calls):
        started = time.perf_counter()
        function(theta, w)
        times.append(time.perf_counter() - started)
    return min(times)


# ---------------------------------------------------------------------------------------------- gradient quality

MAX_REFERENCE_SHARE = 0.5
"""Largest share of a measured squared error that the reference's own error may cause."""

_qualities: dict[tuple[Any, ...], dict[str, float]] = {}


def gradient_quality(search: OptimizerRun, theta: np.ndarray, settings: Settings) -> dict[str, float] | None:
    """Return relative error, cosine and share of bias of the estimator's gradients at ``theta (d,)``.

    Returns None without an estimator. The reference is the mean of many gradients or of many zeroth-order terms,
    whichever vary less. Where the cost jumps or the backend has no gradients, it is the mean of zeroth-order terms.
    """
    cell, problem, estimator = search.cell, search.problem, search.estimator
    if estimator is None:
        return None
    key = (
        cell.program_key, cell.backend, estimator, cell.samples, cell.repeats, settings.quality_samples, theta.tobytes(),
    )  # fmt: skip
    if key not in _qualities:
        program, scene = problem.program, cell.scene.name
        w = noise.draw(0, scene, 1, settings.quality_samples, program.n_noise, "optimise: reference")[0].T
        with np.errstate(all="ignore"):
            cost = problem.value(theta, w) - problem.value(theta, 0.0 * w[:, :1])
            terms = cost * problem.score(theta, w)
            if program.continuous and "grad" in cell.backend.provides:
                first = problem.grad(theta, w)
                terms = first if first.var(axis=1).sum() < terms.var(axis=1).sum() else terms
        drawn = noise.draw(0, scene, max(cell.repeats, 2), cell.samples, program.n_noise, "optimise: quality")
        _qualities[key] = compare_with_reference(estimator.estimate(problem, theta, drawn), terms)
    return _qualities[key]


def compare_with_reference(estimates: np.ndarray, terms: np.ndarray) -> dict[str, float]:
    """Return relative RMSE, mean cosine and share of bias of estimates ``(R, d)`` against the mean of terms ``(d, M)``.

    The noise of the reference and of the mean estimate is subtracted from the bias. All values are NaN if the reference
    is too uncertain: its squared error exceeds :data:`MAX_REFERENCE_SHARE` of the measured squared error.
    """
    truth = terms.mean(axis=1)
    reference_error = float(terms.var(axis=1, ddof=1).sum()) / terms.shape[1]
    norm = float(np.linalg.norm(truth))
    errors = estimates - truth
    measured = float((errors**2).sum(axis=1).mean())
    if not reference_error <= MAX_REFERENCE_SHARE * measured:
        return dict.fromkeys(("rmse_rel", "cosine", "bias_share"), np.nan)
    error = measured - reference_error
    spread = float(estimates.var(axis=0, ddof=1).sum())
    bias = max(float((errors.mean(axis=0) ** 2).sum()) - spread / len(estimates) - reference_error, 0.0)
    sizes = np.linalg.norm(estimates, axis=1) * norm
    cosines = np.divide(estimates @ truth, sizes, out=np.zeros(len(estimates)), where=sizes > 0)
    return {
        "rmse_rel": float(np.sqrt(error)) / norm if norm else np.nan,
        "cosine": float(cosines.mean()),
        "bias_share": min(bias / error, 1.0) if error else 0.0,
    }
