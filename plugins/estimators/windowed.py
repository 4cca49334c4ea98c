"""Gradients through short windows with a terminal value, instead of through one long rollout."""

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
    adjoint,
    adjoint_gradient,
    columns,
    first_order,
    param,
    per_repeat,
    slope_by_changes,
    slopes,
)


@dataclass(frozen=True)
class Windowed(Estimator):
    """Approximates grad J_sigma with first-order gradients within windows of ``steps`` time steps.

    No gradient crosses a window's end. The terminal value of a window is ``none`` (0: truncated backpropagation through
    time), ``exact`` (the scene's optimal cost-to-go), or ``learned`` (the cost-to-go of the batch's rollouts, fitted by
    a quadratic in the state per window and repeat; the idea of SHAC, Xu et al. 2022). With the exact value, the optimal
    control is a fixed point at every window length. Without a value, the first control of a window of H steps equals
    the control after H Riccati steps from 0. A window also ends where the distance of a step's Jacobian from the
    identity exceeds ``cut`` (the idea of AHAC, Georgiev et al. 2024). Short windows have low variance and high bias,
    long windows the reverse. On plain functions, and with a single window, the estimate equals ``fobg``. Requires
    gradients.
    """

    name = "windowed"
    uses = (adjoint,)
    needs = frozenset({"grad"})
    unbiased = False

    steps: int = param(16, "length of a window", "steps", positive=True)
    terminal: str = param("none", "terminal value of a window", choices=("none", "exact", "learned"))
    cut: float | None = param(
        None, "distance of a step's Jacobian from the identity at which a window ends early; null: never", positive=True
    )
    ridge: float = param(1e-3, "ridge penalty of the fitted value, per sample", positive=True)

    def own_refusal(self, program: Program) -> str | None:
        if self.terminal == "exact" and not isinstance(program.scene, KnownValue | FunctionScene):
            return f"{self.name}[terminal=exact] needs a scene that knows its cost-to-go, and {program.scene.name} does not"
        if program.decision.names and isinstance(program, Rollout):
            return f"{self.name} cuts gradients by the controls: theta must be the scene's own, not {list(program.decision.names)}"
        return None

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        program, w = problem.program, columns(noise)
        if not isinstance(program, Rollout) or (self.steps >= program.scene.horizon and self.cut is None):
            return first_order(problem, theta, noise).mean(axis=1)
        path = slopes(problem, theta, w)
        problem.usage.gradients += w.shape[1]
        ends = self._ends(path)
        value = self._value(problem, path, noise.shape[:2])

        def cut(t: int, states: np.ndarray, adjoint: np.ndarray) -> np.ndarray:
            if not ends[t].any():
                return adjoint
            by_change = slope_by_changes(problem.program.scene, states, value(t, states))  # type: ignore[arg-type]
            return np.where(ends[t], by_change, adjoint)

        return per_repeat(adjoint_gradient(problem, path, cut), noise).mean(axis=1)

    def _ends(self, path: Slopes) -> np.ndarray:
        """Return whether a window ends before step t, ``(T, B)``."""
        steps, size = len(path.a), path.a.shape[1]
        ends = np.repeat((np.arange(steps) % self.steps == 0)[:, None], path.a.shape[3], axis=1)
        if self.cut is not None:
            ends |= np.sqrt(((path.a - np.eye(size)[None, :, :, None]) ** 2).sum(axis=(1, 2))) > self.cut
        return ends

    def _value(self, problem: Problem, path: Slopes, shape: tuple[int, ...]) -> Callable[[int, np.ndarray], np.ndarray]:
        """Return a function of step t and states ``(n, B)`` that returns the derivative of the terminal value, ``(n, B)``."""
        scene = problem.program.scene
        if self.terminal == "exact":
            assert isinstance(scene, KnownValue)
            n_q = scene.n_q  # type: ignore[attr-defined]
            return lambda t, x: _slope(lambda y: scene.cost_to_go(y[:n_q], y[n_q:], t), x)
        if self.terminal == "learned":
            to_go = np.cumsum(path.cost[::-1], axis=0)[::-1]
            return lambda t, x: _fitted_slope(x, to_go[t], shape, self.ridge)
        return lambda t, x: 0.0 * x


def _slope(value: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Return the derivative of ``value`` at ``x (n, B)`` by central differences, ``(n, B)``; exact for a quadratic."""
    shifts = step * np.eye(len(x))[:, :, None]
    return np.stack([(value(x + shift) - value(x - shift)) / (2 * step) for shift in shifts])


def _fitted_slope(x: np.ndarray, to_go: np.ndarray, shape: tuple[int, ...], ridge: float) -> np.ndarray:
    """Return the derivative at ``x (n, R N)`` of a ridge fit to costs-to-go in standardised states, per repeat.

    The fit is quadratic if a repeat has at least twice as many samples as coefficients, else linear. Coordinates that
    do not vary have derivative 0.
    """
    (repeats, samples), n = shape, len(x)
    slope = np.zeros((n, repeats, samples))
    states, costs = x.reshape(n, repeats, samples), to_go.reshape(repeats, samples)
    for r in range(repeats):
        spread = states[:, r].std(axis=1)
        varying = np.flatnonzero(spread > 1e-12 * (1 + np.abs(states[:, r]).max(axis=1)))
        if not varying.size or not np.isfinite(costs[r]).all():
            continue
        z = (states[varying, r] - states[varying, r].mean(axis=1, keepdims=True)) / spread[varying, None]
        pairs = [(i, j) for i in range(varying.size) for j in range(i + 1)]
        quadratic = samples >= 2 * (1 + varying.size + len(pairs))
        rows = [np.ones(samples), *z, *(z[i] * z[j] for i, j in pairs if quadratic)]
        design = np.stack([*rows], axis=1)
        penalty = math.sqrt(ridge * samples) * np.eye(design.shape[1])
        penalty[0, 0] = 0.0
        fitted = np.linalg.lstsq(
            np.concatenate([design, penalty]), np.append(costs[r], np.zeros(len(penalty))), rcond=None
        )[0]
        by_z = np.repeat(fitted[1 : 1 + varying.size, None], samples, axis=1)
        if quadratic:
            for coefficient, (i, j) in zip(fitted[1 + varying.size :], pairs, strict=True):
                by_z[i] += coefficient * z[j]
                by_z[j] += coefficient * z[i]
        slope[varying, r] = by_z / spread[varying, None]
    return slope.reshape(n, -1)
