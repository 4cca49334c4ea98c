"""Iterative linear-quadratic regulator."""

from dataclasses import dataclass

import numpy as np

from bench.model import Answer, Expansion, OptimizerState, PathOptimizer, param

FACTOR = 1.6
"""Growth of the factor by which the damping changes at each failure or success in succession (Tassa et al. 2012)."""
LARGEST = 1e10
"""Damping at which the backward pass is given up."""
SINGULAR = 1e-10
"""Smallest eigenvalue of the second derivatives by a control, relative to the terms that they are the sum of."""


@dataclass(frozen=True)
class Ilqr(PathOptimizer):
    """The iterative linear-quadratic regulator (Li, Todorov 2004), for scenes whose theta is the control of each step.

    A backward pass solves the regulator problem of the linearised steps and the quadratic costs along a rollout: a
    change of each control and a gain. Trial rollouts apply 1, ``shrink``, ``shrink``^2, ... of the changes with the
    whole gains, and the longest one with ``slope`` of the predicted descent is taken. Second derivatives of the steps
    are dropped, so this is not differential dynamic programming. Where the second derivatives by a control are not
    positive, or no trial descends, a multiple of the identity is added to them, which grows and shrinks as in Tassa et
    al. 2012. A step counts as one gradient and ``tries`` rollouts.
    """

    name = "ilqr"

    damping: float = param(0.0, "initial multiple of the identity", low=0.0)
    least: float = param(1e-6, "smallest damping other than 0", positive=True)
    shrink: float = param(0.5, "factor between two trial steps", positive=True, high=0.99)
    slope: float = param(1e-4, "required share of the predicted descent", positive=True, high=1.0)
    tries: int = param(10, "number of trial steps", positive=True)

    def start(self, theta: np.ndarray) -> OptimizerState:
        """Return the initial state: theta and the damping, with its last factor."""
        return super().start(theta) | {"damping": self.damping, "factor": 1.0}

    def ask(self, state: OptimizerState, noise: np.ndarray) -> np.ndarray:
        """Return theta, ``(d, 1)``."""
        return np.array(state["theta"][:, None])

    def tell(self, state: OptimizerState, theta: np.ndarray, answer: Answer) -> OptimizerState:
        """Return the state after the longest trial with sufficient descent, or with more damping."""
        path = answer.path
        assert path is not None
        damping, factor = state["damping"], state["factor"]
        if not np.isfinite(path.cost):
            return state
        while (law := self.backward(path, damping)) is None:
            damping, factor = self._more(damping, factor)
            if damping > LARGEST:
                return state
        changes, gains, descent, curvature = law
        shares = self.shrink ** np.arange(self.tries)
        controls, costs = path.follow(path.controls[..., None] + changes[..., None] * shares, gains)
        required = self.slope * (shares * descent - 0.5 * shares**2 * curvature)
        with np.errstate(invalid="ignore"):
            accepted = np.flatnonzero(path.cost - costs > required)
        if not accepted.size:
            damping, factor = self._more(damping, factor)
            return {"theta": state["theta"], "damping": min(damping, LARGEST), "factor": factor}
        factor = min(factor / FACTOR, 1.0 / FACTOR)
        damping = damping * factor if damping * factor >= self.least else 0.0
        return {"theta": controls[..., accepted[0]].ravel(), "damping": damping, "factor": factor}

    def _more(self, damping: float, factor: float) -> tuple[float, float]:
        factor = max(factor * FACTOR, FACTOR)
        return max(damping * factor, self.least), factor

    def backward(self, path: Expansion, damping: float) -> tuple[np.ndarray, np.ndarray, float, float] | None:
        """Return changes ``(T, m)``, gains ``(T, m, k)``, and slope and curvature of the descent along the changes.

        None if the damped second derivatives by a control are not positive.
        """
        horizon, k, m = path.b.shape
        changes, gains = np.empty((horizon, m)), np.empty((horizon, m, k))
        value_x, value_xx = path.cost_x[-1], path.cost_xx[-1]
        descent = curvature = 0.0
        largest = float(np.abs(value_xx).max(initial=0.0))
        for t in range(horizon - 1, -1, -1):
            x, u, xx, ux, uu = self.action_value(path, t, value_x, value_xx)
            damped = uu + damping * np.eye(m)
            size = np.abs(path.cost_uu[t]).max(initial=0.0) + largest * np.sum(path.b[t] ** 2)
            if not np.linalg.eigvalsh(damped).min(initial=np.inf) > SINGULAR * size:
                return None
            solved = np.linalg.solve(damped, np.concatenate([u[:, None], ux], axis=1))
            change, gain = -solved[:, 0], -solved[:, 1:]
            changes[t], gains[t] = change, gain
            descent -= float(change @ u)
            curvature += float(change @ uu @ change)
            value_x = x + gain.T @ (uu @ change + u) + ux.T @ change
            value_xx = xx + gain.T @ uu @ gain + gain.T @ ux + ux.T @ gain
            value_xx = 0.5 * (value_xx + value_xx.T)
            largest = max(largest, float(np.abs(value_xx).max(initial=0.0)))
        return changes, gains, descent, curvature

    def action_value(
        self, path: Expansion, t: int, value_x: np.ndarray, value_xx: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Return the derivatives of the cost from step t on: by x and u, and by xx, ux and uu."""
        a, b = path.a[t], path.b[t]
        return (
            path.cost_x[t] + a.T @ value_x, path.cost_u[t] + b.T @ value_x,
            path.cost_xx[t] + a.T @ value_xx @ a, path.cost_ux[t] + b.T @ value_xx @ a, path.cost_uu[t] + b.T @ value_xx @ b,
        )  # fmt: skip
