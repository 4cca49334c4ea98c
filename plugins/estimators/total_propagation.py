"""First and zeroth order weighted step by step."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.model import Auxiliaries, Estimator, MechanicalScene, Problem, Program, first_order, param, zeroth_order


@dataclass(frozen=True)
class TotalPropagation(Estimator):
    """Approximates grad J_sigma with both orders of the same samples, weighted for each step's controls.

    The weights are v0 / (v0 + v1) and v1 / (v0 + v1), v the summed variances of one step's part of theta: where a
    gradient explodes backwards through time, early steps take the zeroth order and late ones the first. ``per=step``
    weights the controls of a step together (Parmas et al. 2018, total propagation), ``per=control`` each by itself
    (Onoda et al. 2026). Where theta is not a sequence of controls it is one part. Unlike the source's own, the
    zeroth-order terms take the whole cost, not the cost to come, and the weights act once, not within the backward pass.
    Requires costs, gradients and scores. Biased: the weights depend on the samples, and they follow low variance, right
    or wrong. Reports the first-order ``weight`` of each coordinate.
    """

    name = "total_propagation"
    needs = frozenset({"value", "grad", "score"})
    adds_explicit = True
    unbiased = False
    reports: ClassVar[tuple[str, ...]] = ("weight",)

    per: str = param("step", "what is weighted together", choices=("step", "control"))

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return estimates with one weight per repeat and part of theta."""
        return self.explained(problem, theta, noise)[0]

    def explained(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, Auxiliaries]:
        """Return the estimates, and the first-order weights ``(R, d)``. Raises ValueError for a single sample."""
        if noise.shape[1] < 2:
            raise ValueError(f"{self.name} needs at least 2 samples, got 1")
        first, zeroth = first_order(problem, theta, noise), zeroth_order(problem, theta, noise)
        part = 1 if self.per == "control" else _controls(problem.program)
        v1, v0 = (_summed(terms.var(axis=1, ddof=1), part) for terms in (first, zeroth))
        total = v0 + v1
        # with both variances 0 any weight is right
        weight = np.divide(v0, total, out=np.full_like(total, 0.5), where=total > 0)
        return weight * first.mean(axis=1) + (1 - weight) * zeroth.mean(axis=1), {"weight": weight}


def _controls(program: Program) -> int:
    """Return how many coordinates of theta belong to one step: its controls, or all of theta."""
    scene = program.scene
    return scene.n_u if isinstance(scene, MechanicalScene) and scene.open_loop else program.dim


def _summed(variances: np.ndarray, part: int) -> np.ndarray:
    """Return variances ``(R, d)`` replaced by the sums over parts of that many neighbours."""
    sums = variances.reshape(len(variances), -1, part).sum(axis=2)
    return np.repeat(sums, part, axis=1)
