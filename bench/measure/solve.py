"""Newton's method on a problem without noise: the least cost that can be reached, with a certificate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from bench.model import Problem

STEP = 1e-5
"""Step of the differences of gradients that make the Hessian, in units of theta: error about 1e-10 of it."""
ENOUGH = 1e-8
"""A gradient below this share of the first one is 0: differences of costs no longer show it."""
FAR = 1e6
"""A theta this many times its start has run away: the cost has no lower bound that can be found."""
ROUNDING = 1e-13
"""Relative difference of two costs that is rounding."""


@dataclass(frozen=True)
class Solved:
    """A local optimum: its cost and theta, the norm of the gradient there, and the least curvature."""

    cost: float
    theta: np.ndarray
    gradient: float
    curvature: float
    certified: bool
    """Whether the gradient is 0 to rounding and every curvature above -1e-8 of the largest."""


def solve(problem: Problem, theta: np.ndarray | None = None, steps: int = 40) -> Solved:
    """Minimise the cost at w = 0 from ``theta (d,)``, by default the problem's own: L-BFGS, then damped Newton steps.

    The Hessian comes from central differences of gradients, 2 d of them per step. The damping grows tenfold while a
    step does not lower the cost and falls tenfold after one that does (Nocedal, Wright 2006, ch. 10 to 11). A cost
    without lower bound is -inf.
    """
    theta = np.array(problem.program.theta0 if theta is None else theta, dtype=np.float64)
    still = np.zeros((problem.program.n_noise, 1))
    first = max(float(np.linalg.norm(problem.grad(theta, still)[:, 0])), 1e-300)

    def both(x: np.ndarray) -> tuple[float, np.ndarray]:
        return float(problem.value(x, still)[0]), problem.grad(x, still)[:, 0]

    near = minimize(both, theta, jac=True, method="L-BFGS-B", options={"maxiter": 50 * steps, "maxcor": 30})
    theta = near.x if np.isfinite(near.fun) and np.isfinite(near.x).all() else theta
    (cost, gradient), damping = both(theta), 1e-9
    values, vectors = _curvatures(problem, theta)
    for _ in range(steps):
        if np.linalg.norm(gradient) <= 1e-3 * ENOUGH * first:
            break
        while damping < 1e12:
            scale = np.maximum(np.abs(values), 1e-9 * np.abs(values).max()) + damping * np.abs(values).max()
            moved = theta - vectors @ ((vectors.T @ gradient) / scale)
            found, slope = both(moved)
            # below rounding costs no longer decide, gradients do
            level = abs(found - cost) <= ROUNDING * abs(cost)
            if found < cost or (level and np.linalg.norm(slope) < np.linalg.norm(gradient)):
                break
            damping *= 10
        else:
            break
        theta, cost, damping = moved, found, max(damping / 10, 1e-15)
        gradient = slope
        values, vectors = _curvatures(problem, theta)
    norm = float(np.linalg.norm(gradient))
    lowest = float(values.min())
    if np.abs(theta).max() > FAR * (1.0 + np.abs(problem.program.theta0).max()):
        return Solved(-np.inf, theta, norm, lowest, False)
    certified = norm <= ENOUGH * first and lowest >= -1e-8 * float(np.abs(values).max())
    return Solved(cost, theta, norm, lowest, certified)


def _curvatures(problem: Problem, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues and eigenvectors of the Hessian."""
    d = theta.size
    h = STEP * max(1.0, float(np.abs(theta).max()))
    moved = theta[:, None] + h * np.concatenate([np.eye(d), -np.eye(d)], axis=1)
    gradients = problem.grad(moved, np.zeros((problem.program.n_noise, 2 * d)))
    hessian = (gradients[:, :d] - gradients[:, d:]) / (2 * h)
    values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
    return values, vectors
