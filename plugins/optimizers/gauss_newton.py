"""Gauss-Newton with Levenberg's damping."""

from dataclasses import dataclass

import numpy as np

from bench.model import Answer, Optimizer, OptimizerState, param


@dataclass(frozen=True)
class GaussNewton(Optimizer):
    """Minimises |r|^2 / 2 by steps -(J'J + damping D)^-1 J'r (Levenberg 1944, Marquardt 1963).

    D is the largest diag(J'J) so far (Moré 1978). Requires residuals and their Jacobian. A step that increases the cost
    is rejected, and the damping is multiplied by 2, then 4, 8, ... A step that decreases it multiplies the damping by
    max(1/3, 1 - (2 g - 1)^3), with g the decrease over that of the linear model (Nielsen 1999). If J'J is singular, the
    shortest least-squares step is taken.
    """

    name = "gauss_newton"
    needs = frozenset({"residual", "jacobian"})

    damping: float = param(1e-3, "initial damping, relative to the diagonal of J'J", positive=True)

    def start(self, theta: np.ndarray) -> OptimizerState:
        """Return the initial state: the initial damping and no evaluated point."""
        return super().start(theta) | {
            "damping": self.damping,
            "growth": 2.0,
            "scale": np.zeros(len(theta)),
            "known": None,
            "next": np.array(theta, dtype=float),
        }

    def ask(self, state: OptimizerState, noise: np.ndarray) -> np.ndarray:
        return np.array(state["next"][:, None])

    def tell(self, state: OptimizerState, theta: np.ndarray, answer: Answer) -> OptimizerState:
        residual, jacobian = answer.residual[:, 0], answer.jacobian[..., 0]
        finite = np.isfinite(residual).all() and np.isfinite(jacobian).all()
        cost = 0.5 * float(residual @ residual) if finite else np.inf
        known, damping, growth = state["known"], state["damping"], state["growth"]
        scale, best = state["scale"], state["theta"]
        if known is None or cost <= known[0]:
            if known is not None:
                linear = known[1] + known[2] @ (theta[:, 0] - best)
                expected = known[0] - 0.5 * float(linear @ linear)
                gain = (known[0] - cost) / expected if expected > 0.0 else 1.0
                damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-15)
            known, best, growth = (cost, residual, jacobian), theta[:, 0], 2.0
            scale = np.maximum(scale, np.linalg.norm(jacobian, axis=0)) if finite else scale
        else:
            damping, growth = damping * growth, 2.0 * growth
        state = {"theta": best, "damping": damping, "growth": growth, "scale": scale, "known": known, "next": best}
        if not np.isfinite(known[0]):
            return state | {"known": None}
        return state | {"next": best - self._move(known, damping, scale)}

    @staticmethod
    def _move(known: tuple[float, np.ndarray, np.ndarray], damping: float, scale: np.ndarray) -> np.ndarray:
        _, residual, jacobian = known
        weight = np.sqrt(damping) * scale
        stacked = np.concatenate([jacobian, np.diag(weight)])
        return np.linalg.lstsq(stacked, np.concatenate([residual, 0.0 * weight]), rcond=None)[0]
