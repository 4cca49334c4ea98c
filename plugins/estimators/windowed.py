"""Short windows with a value at their ends, instead of one long rollout."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bench.model import (
    Estimator,
    FunctionScene,
    KnownValue,
    Problem,
    Program,
    Rollout,
    Slopes,
    adjoint_gradient,
    columns,
    param,
    per_repeat,
    slopes,
)


@dataclass(frozen=True)
class Windowed(Estimator):
    """Approximates grad J_sigma with first-order gradients through windows of ``steps`` steps; no gradient crosses their ends.

    At the end of a window stands a value of the state reached: ``none`` (0: truncated backpropagation through time),
    ``exact`` (the scene's least cost to go), or ``learned`` (the cost to go of the batch's rollouts, fitted by a
    quadratic in the state, one per window and repeat; the idea of SHAC, Xu et al. 2022). With the exact value the
    optimal control is a fixed point at every length; with none the first control of a window of H steps is that of H
    Riccati steps from 0. ``cut`` also ends a window wherever a step's Jacobian is further than that from the identity
    (the idea of AHAC, Georgiev et al. 2024). Short windows have little variance and much bias, long ones the reverse.
    On plain functions, and in one window, it is ``fobg``. Requires gradients.
    """

    name = "windowed"
    needs = frozenset({"grad"})
    unbiased = False

    steps: int = param(16, "length of a window", "steps", positive=True)
    terminal: str = param("none", "value at the end of a window", choices=("none", "exact", "learned"))
    cut: float | None = param(
        None, "distance of a step's Jacobian from 1 at which a window ends early; null: none", positive=True
    )
    ridge: float = param(1e-3, "weight of the fitted value's squared coefficients, per sample", positive=True)

    def unsupported_reason(self, program: Program) -> str | None:
        """Refuse an exact value that the scene does not know, and a theta of named parameters, which acts in every step."""
        if self.terminal == "exact" and not isinstance(program.scene, KnownValue | FunctionScene):
            return f"{self.name}[terminal=exact] needs a scene that knows its cost to go, which {program.scene.name} does not"
        if program.decision.names and isinstance(program, Rollout):
            return f"{self.name} cuts gradients by the controls: theta must be the scene's own, not {list(program.decision.names)}"
        return None

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the mean over samples of the gradient through windows."""
        program, w = problem.program, columns(noise)
        if not isinstance(program, Rollout) or (self.steps >= program.scene.horizon and self.cut is None):
            return np.asarray(per_repeat(problem.grad(theta, w), noise).mean(axis=1))
        found = slopes(problem, theta, w)
        problem.usage.gradients += w.shape[1]
        ends = self._ends(found)
        value = self._value(problem, found, noise.shape[:2])

        def cut(t: int, states: np.ndarray, adjoint: np.ndarray) -> np.ndarray:
            if not ends[t].any():
                return adjoint
            return np.where(ends[t], value(t, states), adjoint)

        return np.asarray(per_repeat(adjoint_gradient(problem, found, cut), noise).mean(axis=1))

    def _ends(self, found: Slopes) -> np.ndarray:
        """Return whether a window ends before step t, ``(T, B)``."""
        steps, size = len(found.a), found.a.shape[1]
        ends = np.repeat((np.arange(steps) % self.steps == 0)[:, None], found.a.shape[3], axis=1)
        if self.cut is not None:
            ends |= np.sqrt(((found.a - np.eye(size)[None, :, :, None]) ** 2).sum(axis=(1, 2))) > self.cut
        return ends

    def _value(
        self, problem: Problem, found: Slopes, shape: tuple[int, ...]
    ) -> Callable[[int, np.ndarray], np.ndarray]:
        """Return the slope of the value by the state before step t, ``(n, B)``."""
        scene = problem.program.scene
        if self.terminal == "exact":
            assert isinstance(scene, KnownValue)
            n_q = scene.n_q  # type: ignore[attr-defined]
            return lambda t, x: _slope(lambda y: scene.cost_to_go(y[:n_q], y[n_q:], t), x)
        if self.terminal == "learned":
            to_go = np.cumsum(found.cost[::-1], axis=0)[::-1]
            return lambda t, x: _fitted_slope(x, to_go[t], shape, self.ridge)
        return lambda t, x: 0.0 * x


def _slope(value: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Return central differences, exact to rounding for a quadratic value."""
    shifts = step * np.eye(len(x))[:, :, None]
    return np.stack([(value(x + shift) - value(x - shift)) / (2 * step) for shift in shifts])


def _fitted_slope(x: np.ndarray, to_go: np.ndarray, shape: tuple[int, ...], ridge: float) -> np.ndarray:
    """Return the slope at ``x (n, R N)`` of a ridge fit to costs to go, repeat by repeat, in standardised states.

    The fit is quadratic where a repeat has twice the samples that it takes, else linear; coordinates that do not vary
    have slope 0.
    """
    (repeats, samples), n = shape, len(x)
    slope = np.zeros((n, repeats, samples))
    states, costs = x.reshape(n, repeats, samples), to_go.reshape(repeats, samples)
    for r in range(repeats):
        spread = states[:, r].std(axis=1)
        own = np.flatnonzero(spread > 1e-12 * (1 + np.abs(states[:, r]).max(axis=1)))
        if not own.size or not np.isfinite(costs[r]).all():
            continue
        z = (states[own, r] - states[own, r].mean(axis=1, keepdims=True)) / spread[own, None]
        pairs = [(i, j) for i in range(own.size) for j in range(i + 1)]
        quadratic = samples >= 2 * (1 + own.size + len(pairs))
        rows = [np.ones(samples), *z, *(z[i] * z[j] for i, j in pairs if quadratic)]
        design = np.stack([*rows], axis=1)
        penalty = math.sqrt(ridge * samples) * np.eye(design.shape[1])
        penalty[0, 0] = 0.0
        fitted = np.linalg.lstsq(
            np.concatenate([design, penalty]), np.append(costs[r], np.zeros(len(penalty))), rcond=None
        )[0]
        by_z = np.repeat(fitted[1 : 1 + own.size, None], samples, axis=1)
        if quadratic:
            for coefficient, (i, j) in zip(fitted[1 + own.size :], pairs, strict=True):
                by_z[i] += coefficient * z[j]
                by_z[j] += coefficient * z[i]
        slope[own, r] = by_z / spread[own, None]
    return slope.reshape(n, -1)
