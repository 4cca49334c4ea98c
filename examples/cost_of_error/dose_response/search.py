"""Runs the searches of one method on one problem: tunes the rate, then scores it on other seeds, in shared batches."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from bench.plugins.studies.optimise.measure import advance, estimates, mean_costs, objective

from bench.host.parameters import parameters
from bench.measure import noise
from bench.model import Answer, Estimator, Optimizer, Problem

from .batched import run_batched

TARGETS = (10.0, 30.0, 100.0, 300.0, 1000.0)
"""Factors by which the regret of a search has to fall."""
DIVERGED = 1e3
"""Multiple of the first regret above the start cost at which a search has diverged."""
MOST_NUMBERS = 1 << 23
"""Most numbers of noise or gradients that a shared call of several searches may hold (64 MiB)."""


@dataclass(frozen=True)
class Task:
    """The problem that searches share: the scored noise, the first cost, the optimum, and the number of updates."""

    scene: str
    scored: np.ndarray
    """Noise of the objective, ``(n_w, M)``: one column of zeros for the cost without noise."""
    start: float
    optimum: float
    iterations: int

    @property
    def levels(self) -> np.ndarray:
        """The costs of :data:`TARGETS`."""
        return self.optimum + (self.start - self.optimum) / np.asarray(TARGETS)


@dataclass(frozen=True)
class Method:
    """An optimizer with its gradient: an estimator and its samples, or None for an optimizer that uses only costs."""

    optimizer: Optimizer
    estimator: Estimator | None
    samples: int
    is_random: bool = True
    """Whether gradients depend on the noise; if not, all seeds have the same path."""


@dataclass
class Search:
    """The result of one search."""

    updates: list[float]
    """Updates until each target; infinite if it was missed."""
    rollouts: float
    """Rollouts per update, without those that score the path."""
    gradients: float
    lowest: float
    """Lowest regret over the first regret."""
    steps: int
    thetas: list[np.ndarray] = dataclasses.field(default_factory=list)


@lru_cache(maxsize=32)
def _noise(seed: int, scene: str, samples: int, width: int, iteration: int) -> np.ndarray:
    """Return the noise of one update, which searches at several rates share."""
    return noise.draw(seed, scene, 1, samples, width, f"dose_response: samples {iteration}")


def follow(problem: Problem, method: Method, task: Task, seed: int, keep: bool = False) -> Search:
    """Search until the last target, divergence or the number of updates; ``keep`` returns theta at every update."""
    optimizer, width = method.optimizer, problem.program.n_noise
    state = optimizer.start(problem.program.theta0)
    updates, lowest, thetas, i = [math.inf] * len(TARGETS), math.inf, [], 0
    problem.usage.rollouts = problem.usage.gradients = 0
    first = task.start - task.optimum
    while True:
        cost = objective(problem, state["theta"], task.scored)
        if keep:
            thetas.append(np.array(state["theta"]))
        if not math.isfinite(cost) or cost > task.start + DIVERGED * first:
            break
        lowest = min(lowest, (cost - task.optimum) / first)
        updates = [min(u, i) if cost <= level else u for u, level in zip(updates, task.levels, strict=True)]
        if i >= task.iterations or math.isfinite(updates[-1]):
            break
        i += 1
        draws = optimizer.draws(problem.dim)
        normal = noise.draw(seed, task.scene, 1, draws, problem.dim, f"dose_response: points {i}")[0].T
        place = (seed, i) if method.is_random else (0, 0)
        drawn = _noise(place[0], task.scene, method.samples, width, place[1]).copy(order="K")  # methods share the noise
        state = advance(
            optimizer,
            state,
            normal,
            partial(mean_costs, problem, w=task.scored),
            partial(estimates, problem, method.estimator, w=drawn),
        )
    share = 1.0 / max(i, 1)
    return Search(updates, problem.usage.rollouts * share, problem.usage.gradients * share, lowest, i, thetas)


def run_searches(
    problem: Problem, task: Task, methods: Sequence[Method], seeds: Sequence[int], keep: bool = False
) -> list[Search]:
    """Return the searches of each pair of method and seed; searches share calls of the problem."""
    samples = max(max(m.samples for m in methods) if methods[0].is_random else 1, task.scored.shape[1])
    group = max(1, MOST_NUMBERS // (samples * max(problem.dim, problem.program.n_noise)))
    jobs = [
        partial(follow, method=method, task=task, seed=seed, keep=keep)
        for method, seed in zip(methods, seeds, strict=True)
    ]
    parts = (run_batched(problem, jobs[start : start + group]) for start in range(0, len(jobs), group))
    return [search for part in parts for search in part]


# ------------------------------------------------------------------------------------------------------ tuning


@dataclass
class Tuning:
    """The searches of a method by rate, and the best rate of each target."""

    rates: list[float]
    updates: np.ndarray
    """Median updates until each target, infinite where most searches miss it: ``(rates, targets)``."""
    best: list[int]
    """Index of the best rate of each target."""
    rollouts: float
    """Rollouts of all searches of the tuning."""
    gradients: float
    is_inside: list[bool]
    """Whether the best rate of each target is inside the grid."""


def tuned_parameter(optimizer: Optimizer) -> str | None:
    """Return the parameter that is tuned: the rate, else the initial width, or None."""
    return next((name for name in ("rate", "width", "first") if name in parameters(type(optimizer))), None)


def unit_rate(optimizer: Optimizer, gradient: np.ndarray | None) -> float:
    """Return the value of the tuned parameter at which the largest element of the first step is about 1."""
    name = tuned_parameter(optimizer)
    if name != "rate" or gradient is None:
        return 1.0
    unit = dataclasses.replace(optimizer, rate=1.0)  # type: ignore[call-arg]
    state = unit.start(0.0 * gradient)
    moved = unit.tell(state, state["theta"][:, None], Answer(None, gradient[:, None]))
    size = float(np.abs(moved["theta"]).max())
    return 1.0 / size if size > 0 else 1.0


def tune(
    problem: Problem,
    task: Task,
    method: Method,
    seeds: Sequence[int],
    grid: Sequence[float],
    widenings: int,
) -> Tuning:
    """Search at each rate of a log-spaced grid, widen the grid until the best rates are inside, and return all.

    The best rate of a target has the lowest median number of updates. Where no rate reaches the target in most seeds,
    it has the lowest median of the lowest regret.
    """
    name = tuned_parameter(method.optimizer)
    found: dict[float, list[Search]] = {}
    rates = list(grid) if name else [0.0]
    step = grid[1] / grid[0]
    for widening in range(widenings + 1):
        missing = [rate for rate in rates if rate not in found]
        pairs = [(rate, seed) for rate in missing for seed in seeds]
        methods = [with_rate(method, rate) for rate, _ in pairs]
        for (rate, _), search in zip(pairs, run_searches(problem, task, methods, [s for _, s in pairs]), strict=True):
            found.setdefault(rate, []).append(search)
        rates = sorted(found)
        updates = np.array([np.median([s.updates for s in found[rate]], axis=0) for rate in rates])
        lowest = np.array([np.median([s.lowest for s in found[rate]]) for rate in rates])
        best = [int(np.lexsort((lowest, updates[:, k]))[0]) for k in range(len(TARGETS))]
        if not name or widening == widenings:
            break
        wider = ([rates[0] / step**2, rates[0] / step] if min(best) == 0 else []) + (
            [rates[-1] * step, rates[-1] * step**2] if max(best) == len(rates) - 1 else []
        )
        if not wider:
            break
        rates = sorted([*rates, *wider])
    everything = [search for some in found.values() for search in some]
    return Tuning(
        rates,
        updates,
        best,
        sum(s.rollouts * s.steps for s in everything),
        sum(s.gradients * s.steps for s in everything),
        [not name or 0 < b < len(rates) - 1 for b in best],
    )


def with_rate(method: Method, rate: float) -> Method:
    """Return the method with a value of its tuned parameter."""
    name = tuned_parameter(method.optimizer)
    if name is None:
        return method
    return dataclasses.replace(method, optimizer=dataclasses.replace(method.optimizer, **{name: rate}))
