"""Gauss-Newton with Levenberg's damping."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.model import Answer, Optimizer, OptimizerState, param


@dataclass(frozen=True)
class GaussNewton(Optimizer):
    """Minimises |r|^2 / 2 by steps -(J'J + damping diag(J'J))^-1 J'r (Levenberg 1944, Marquardt 1963).

    Requires residuals and their Jacobian. A step that increases the cost is rejected and the damping multiplied by ten.
    A step that decreases it divides the damping by ten. If J'J is singular, the shortest least-squares step is taken.
    """

    name = "gauss_newton"
    needs: ClassVar[frozenset[str]] = frozenset({"residual", "jacobian"})

    damping: float = param(1e-3, "initial damping, relative to the diagonal of J'J", positive=True)

    def start(self, theta: np.ndarray) -> OptimizerState:
        """Return the initial state: the initial damping and no evaluated point."""
        return super().start(theta) | {"damping": self.damping, "known": None, "next": np.array(theta, dtype=float)}

    def ask(self, state: OptimizerState, noise: np.ndarray) -> np.ndarray:
        """Return the next point, ``(d, 1)``."""
        return np.array(state["next"][:, None])

    def tell(self, state: OptimizerState, theta: np.ndarray, answer: Answer) -> OptimizerState:
        """Return the state after accepting or rejecting the point, with the next step from the best point."""
        assert answer.residual is not None
        assert answer.jacobian is not None
        residual, jacobian = answer.residual[:, 0], answer.jacobian[..., 0]
        finite = np.isfinite(residual).all() and np.isfinite(jacobian).all()
        cost = 0.5 * float(residual @ residual) if finite else np.inf
        known, damping, best = state["known"], state["damping"], state["theta"]
        if known is None or cost <= known[0]:
            damping = max(damping / 10, 1e-15) if known is not None else damping
            known, best = (cost, residual, jacobian), theta[:, 0]
        else:
            damping = damping * 10
        if not np.isfinite(known[0]):
            return {"theta": best, "damping": damping, "known": None, "next": best}
        return {"theta": best, "damping": damping, "known": known, "next": best - self._move(known, damping)}

    @staticmethod
    def _move(known: tuple[float, np.ndarray, np.ndarray], damping: float) -> np.ndarray:
        _, residual, jacobian = known
        scale = np.sqrt(damping) * np.linalg.norm(jacobian, axis=0)
        stacked = np.concatenate([jacobian, np.diag(scale)])
        return np.asarray(np.linalg.lstsq(stacked, np.concatenate([residual, 0.0 * scale]), rcond=None)[0])
