"""Follows a descent of J_sigma from theta0 to an optimum, so that gradients can be taken at any share of it.

The path is that of one named program. Every contact law, stiffness, backend and estimator is compared at its thetas.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bench.errors import Unsupported
from bench.measure.reference import draw_columns
from bench.model import Problem

REVISION = 1
"""Raised when a path that this module computes moves."""
PAIRS = 1024
"""Pairs of rollouts with noise of either sign, the same at every step: J_sigma is their mean cost."""
GROWTH, STRAIGHT = 1.5, 0.9
"""The step size grows by this factor where the gradient along a step falls to no less than this share, and is halved elsewhere."""


class DescentPoint(NamedTuple):
    """A share of a descent: theta there, the norm of the gradient at its start, and what the path is like."""

    theta: tuple[float, ...]
    start_norm: float
    along: dict[str, list[float]]
    """Lists, by share: ``share``, the norm of ``theta``, ``cost``, ``gradient``, ``speed`` and ``move``, see :class:`DescentPath`."""


@dataclass(frozen=True)
class DescentPath:
    """A path of K thetas with falling costs, or the ``reason`` why there is none.

    ``thetas (K, d)``, and per theta J_sigma ``costs``, the norms ``gradients`` of its gradient, the largest ``speeds``
    of a coordinate along the rollout without noise, and the largest distances ``moves`` of a coordinate from its start:
    NaN if the backend does not expose states, or the scene has none.
    """

    thetas: list[list[float]]
    costs: list[float]
    gradients: list[float]
    speeds: list[float]
    moves: list[float]
    reason: str = ""

    def at(self, share: float) -> DescentPoint:
        """Return the point where this share of the gain in cost is reached, theta rounded to 6 significant digits.

        Values between two thetas of the path are interpolated. Raises :class:`Unsupported` with the reason if there is no
        path.
        """
        if self.reason:
            raise Unsupported(f"no descent: {self.reason}")
        costs, thetas = np.array(self.costs), np.array(self.thetas)
        gained = (costs[0] - costs) / (costs[0] - costs[-1])
        # shares of a descent at which rows show its path, besides their own
        shares = sorted({0.0, 0.25, 0.5, 0.75, 0.9, share})

        def between(values: Any) -> list[float]:
            return [float(value) for value in np.interp(shares, gained, values)]

        points = np.array([between(values) for values in thetas.T])
        theta = points[:, shares.index(share)]
        along = {
            "share": shares,
            "theta": np.linalg.norm(points, axis=0).tolist(),
            **{name: between(getattr(self, f"{name}s")) for name in ("cost", "gradient", "speed", "move")},
        }
        # significant digits of thetas along a path
        return DescentPoint(tuple(float(f"{value:.6g}") for value in theta), self.gradients[0], along)


class _Objective:
    """J_sigma of a problem and its gradient under given noise ``w (n_w, B)``.

    The gradient is the mean of the program's gradients, or of costs times scores where the cost may jump or the backend
    has no gradients.
    """

    def __init__(self, problem: Problem) -> None:
        program = problem.program
        self.problem = problem
        self.is_smooth = program.continuous and not program.surrogate and "grad" in problem.provides

    def cost(self, theta: np.ndarray, w: np.ndarray) -> float:
        """Return the mean cost at ``theta (d,)``."""
        return float(self.problem.value(theta, w).mean())

    def gradient(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return the gradient ``(d,)`` at ``theta (d,)``."""
        if self.is_smooth:
            return self.problem.grad(theta, w).mean(axis=1)
        costs = self.problem.value(theta, w)
        return np.asarray(((costs - costs.mean()) * self.problem.score(theta, w)).mean(axis=1))


@dataclass
class _Steps:
    """The thetas of a descent so far, with their costs and gradients."""

    thetas: list[np.ndarray]
    costs: list[float]
    slopes: list[np.ndarray]


@np.errstate(over="ignore", invalid="ignore")
def descend(problem: Problem) -> DescentPath:
    """Return the descent of J_sigma from theta0 by gradient steps under common noise.

    A step that would raise the cost is halved. There is no descent where no optimum is reached.
    """
    objective = _Objective(problem)
    if not objective.is_smooth and problem.program.score_refusal:
        return _none(problem.program.score_refusal)
    w, fresh = (_pairs(problem, block) for block in (0, 1))
    path, has_ended = _followed(objective, problem.program.theta0, w)
    costs, taken = path.costs, f"{len(path.costs) - 1} steps"
    if not has_ended:
        return _none(f"the cost still falls after {taken}, from {costs[0]:.4g} to {costs[-1]:.4g}")
    norms = [float(np.linalg.norm(slope)) for slope in path.slopes]
    if not np.isfinite([*costs, *norms]).all():
        return _none(f"at step {len(costs) - 1} costs or gradients are not finite")
    gain = problem.value(path.thetas[0], fresh) - problem.value(path.thetas[-1], fresh)
    gain = gain.reshape(2, -1).mean(axis=0)
    error = float(gain.std(ddof=1)) / math.sqrt(gain.size)
    # standard errors by which the gain must exceed 0 on noise that the descent has not used
    if not gain.mean() > 3.0 * error:
        return _none(
            f"from theta0 the cost falls by {gain.mean():.2g} +- {error:.2g} in {taken}: theta0 may be an optimum"
        )
    left = float(np.linalg.norm(objective.gradient(path.thetas[-1], fresh))) / norms[0]
    # gradient at the end, on noise that the descent has not used, relative to that at theta0, above which no
    # optimum was reached
    if not left < 0.5:
        return _none(f"no optimum in {taken}: the gradient there is {left:.2g} times that at theta0")
    thetas = np.array(path.thetas)
    return DescentPath(thetas.tolist(), costs, norms, *_motion(problem, thetas))


def _followed(objective: _Objective, theta: np.ndarray, w: np.ndarray) -> tuple[_Steps, bool]:
    """Return the path from ``theta (d,)`` under noise ``w``, and whether it ends: False if the cost still falls."""
    path = _Steps([theta], [objective.cost(theta, w)], [objective.gradient(theta, w)])
    # the length of theta0, or that of the noise on all of theta if it is larger
    scale = max(float(np.linalg.norm(theta)), objective.problem.sigma * math.sqrt(theta.size))
    step = 0.0
    while math.isfinite(path.costs[-1]) and 0.0 < (size := float(np.linalg.norm(path.slopes[-1]))) < math.inf:
        # the first step has a fiftieth of that length
        step = step or 0.02 * scale / size
        new = path.thetas[-1] - step * path.slopes[-1]
        # step, relative to that length, below which no step lowers the cost
        while not (reached := objective.cost(new, w)) < path.costs[-1] and step * size > 1e-9 * scale:
            step /= 2.0
            new = path.thetas[-1] - step * path.slopes[-1]
        if not reached < path.costs[-1]:
            break
        path.thetas.append(new)
        path.costs.append(reached)
        path.slopes.append(objective.gradient(new, w))
        step *= GROWTH if path.slopes[-1] @ path.slopes[-2] >= STRAIGHT * size**2 else 0.5
        # the last steps have gained a negligible share of the whole gain
        if len(path.costs) > 10 and path.costs[-11] - reached < 1e-3 * (path.costs[0] - reached):
            break
        # after 400 steps, or a thousand times that length away, costs count as unbounded below
        if len(path.costs) > 400 or np.linalg.norm(new) > 1e3 * scale:
            return path, False
    return path, True


def _none(reason: str) -> DescentPath:
    return DescentPath([], [], [], [], [], reason)


def _pairs(problem: Problem, block: int) -> np.ndarray:
    """Return noise ``(n_w, 2 PAIRS)``: a half, and the same with the opposite noise and the same own noise of the scene."""
    half = draw_columns(problem, "descent", PAIRS, block)
    return np.concatenate([half, 2.0 * problem.centred(half) - half], axis=1)


def _motion(problem: Problem, path: np.ndarray) -> tuple[list[float], list[float]]:
    """Return the largest speed, and the largest distance of a coordinate from its start, per theta, without noise."""
    n_q = int(getattr(problem.program.scene, "n_q", 0))
    with suppress(Unsupported):
        still = np.repeat(problem.program.noise_free[:, :1], len(path), axis=1)
        states = problem.trajectory(path.T.copy(), still).states
        speeds = np.abs(states[:, n_q:]).max(axis=(0, 1))
        moves = np.abs(states[:, :n_q] - states[:1, :n_q]).max(axis=(0, 1))
        return speeds.tolist(), moves.tolist()
    return [math.nan] * len(path), [math.nan] * len(path)
