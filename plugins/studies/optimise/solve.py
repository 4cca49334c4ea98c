"""Minimises the cost of a problem without noise by Newton's method, and certifies the local minimum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from bench.model import Problem

CONVERGED = 1e-8
"""Share of the first gradient below which a gradient counts as 0, because differences of costs no longer show it."""
ROUNDING = 1e-13
"""Relative difference of two costs that rounding explains."""


@dataclass(frozen=True)
class Solved:
    """A local minimum: cost, theta ``(d,)``, norm of the gradient at theta, and smallest eigenvalue of the Hessian."""

    cost: float
    theta: np.ndarray
    gradient: float
    curvature: float
    certified: bool
    """Whether the gradient is 0 to rounding and no curvature is below -1e-8 times the largest."""
    starts_at_saddle: bool = False
    """Whether the gradient is 0 to rounding at the start, where a curvature is negative."""


def solve(problem: Problem, theta: np.ndarray | None = None, steps: int = 40) -> Solved:
    """Return a local minimum of the cost at w = 0, searched from ``theta (d,)`` (default: the problem's theta0).

    L-BFGS is followed by at most ``steps`` damped Newton steps. The Hessian comes from central differences of
    gradients, 2 d per step. The damping grows tenfold while a step does not lower the cost, and falls tenfold after a
    step that does (Nocedal, Wright 2006, ch. 10 to 11). A saddle at the start is left along its direction of least
    curvature, to the side with the lower cost. A cost without a lower bound is returned as -inf.
    """
    theta = np.array(problem.program.theta0 if theta is None else theta, dtype=np.float64)
    still = np.zeros((problem.program.n_noise, 1))

    def value_and_gradient(x: np.ndarray) -> tuple[float, np.ndarray]:
        return float(problem.value(x, still)[0]), problem.grad(x, still)[:, 0]

    cost, gradient = value_and_gradient(theta)
    values, vectors = _curvatures(problem, theta)
    is_flat = _is_stationary(cost, gradient, values)
    is_saddle = is_flat and float(values.min()) < -1e-8 * float(np.abs(values).max())
    if is_saddle:
        # first step away from a saddle, in units of theta
        step = 1e-3 * max(1.0, float(np.abs(theta).max())) * vectors[:, np.argmin(values)]
        theta = min(theta + step, theta - step, key=lambda x: value_and_gradient(x)[0])
        gradient = value_and_gradient(theta)[1]
    first = max(float(np.linalg.norm(gradient)), 1e-300)
    near = minimize(
        value_and_gradient, theta, jac=True, method="L-BFGS-B", options={"maxiter": 50 * steps, "maxcor": 30}
    )
    theta = near.x if np.isfinite(near.fun) and np.isfinite(near.x).all() else theta
    (cost, gradient), damping = value_and_gradient(theta), 1e-9
    values, vectors = _curvatures(problem, theta)
    for _ in range(steps):
        if np.linalg.norm(gradient) <= 1e-3 * CONVERGED * first:
            break
        while damping < 1e12:
            scale = np.maximum(np.abs(values), 1e-9 * np.abs(values).max()) + damping * np.abs(values).max()
            moved = theta - vectors @ ((vectors.T @ gradient) / scale)
            new_cost, slope = value_and_gradient(moved)
            # where costs differ only by rounding, gradients decide
            is_level = abs(new_cost - cost) <= ROUNDING * abs(cost)
            if new_cost < cost or (is_level and np.linalg.norm(slope) < np.linalg.norm(gradient)):
                break
            damping *= 10
        else:
            break
        theta, cost, damping = moved, new_cost, max(damping / 10, 1e-15)
        gradient = slope
        values, vectors = _curvatures(problem, theta)
    norm = float(np.linalg.norm(gradient))
    lowest = float(values.min())
    # multiple of the problem's theta0 beyond which theta counts as diverged, and the cost as unbounded below
    if np.abs(theta).max() > 1e6 * (1.0 + np.abs(problem.program.theta0).max()):
        return Solved(-np.inf, theta, norm, lowest, False)
    is_small = norm <= CONVERGED * first or (is_flat and not is_saddle)
    certified = is_small and lowest >= -1e-8 * float(np.abs(values).max())
    return Solved(cost, theta, norm, lowest, certified, is_saddle)


def _is_stationary(cost: float, gradient: np.ndarray, values: np.ndarray) -> bool:
    """Return whether rounding of the cost exceeds what a step along the gradient ``(d,)`` can gain, |g|^2 / (2 curvature)."""
    steepest = float(np.abs(values).max())
    return bool(gradient @ gradient <= 2 * steepest * ROUNDING * abs(cost)) and np.isfinite(steepest)


def _curvatures(problem: Problem, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues ``(d,)`` and eigenvectors ``(d, d)`` of the Hessian."""
    d = theta.size
    # step, in units of theta, of the gradient differences for the Hessian, whose relative error is about 1e-10
    h = 1e-5 * max(1.0, float(np.abs(theta).max()))
    moved = theta[:, None] + h * np.concatenate([np.eye(d), -np.eye(d)], axis=1)
    gradients = problem.grad(moved, np.zeros((problem.program.n_noise, 2 * d)))
    hessian = (gradients[:, :d] - gradients[:, d:]) / (2 * h)
    values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
    return values, vectors
