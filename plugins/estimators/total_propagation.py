"""First and zeroth order weighted step by step."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.model import (
    Auxiliaries,
    DiagnosticEstimator,
    MechanicalScene,
    Problem,
    Program,
    Rollout,
    by_actions,
    by_theta,
    columns,
    first_order,
    param,
    per_repeat,
    slopes,
    zeroth_order,
)


@dataclass(frozen=True)
class TotalPropagation(DiagnosticEstimator):
    """Approximates grad J_sigma with both orders of the same samples, weighted for each step's controls.

    The weights are v0 / (v0 + v1) and v1 / (v0 + v1), v the summed variances of one step's part of theta: where a
    gradient explodes backwards through time, early steps take the zeroth order and late ones the first. ``per=step``
    weights the controls of a step together (Parmas et al. 2018, total propagation), ``per=control`` each by itself;
    where theta is not a sequence of controls it is one part. Both take the whole cost in the zeroth-order terms.

    ``per=action`` weights the derivatives by each action of each step before they are chained to theta, so that it works
    under a policy too, and takes the cost to come less its mean over the other samples (Onoda et al. 2026, IVW-H, as far
    as their abstract says: inverse variance per step; they have a critic for the cost to come). It needs noise on the
    actions. Unlike the source of 2018, no weight acts within the backward pass.

    Requires costs, gradients and scores. Biased: the weights depend on the samples, and they follow low variance, right
    or wrong. Reports the first-order ``weight`` of each coordinate, or of each action.
    """

    name = "total_propagation"
    needs = frozenset({"value", "grad", "score"})
    includes_explicit_derivative = True
    unbiased = False
    diagnostics: ClassVar[tuple[str, ...]] = ("weight",)

    per: str = param("step", "what is weighted together", choices=("step", "control", "action"))

    def estimate_with_diagnostics(
        self, problem: Problem, theta: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, Auxiliaries]:
        """Return the estimates, and the first-order weights ``(R, d)``. Raises ValueError for a single sample."""
        if noise.shape[1] < 2:
            raise ValueError(f"{self.name} needs at least 2 samples, got 1")
        if self.per == "action":
            return self._per_action(problem, theta, noise)
        first, zeroth = first_order(problem, theta, noise), zeroth_order(problem, theta, noise)
        part = 1 if self.per == "control" else _controls(problem.program)
        v1, v0 = (_summed(terms.var(axis=1, ddof=1), part) for terms in (first, zeroth))
        weight = _weight(v0, v1)
        return weight * first.mean(axis=1) + (1 - weight) * zeroth.mean(axis=1), {"weight": weight}

    def _per_action(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, Auxiliaries]:
        repeats, samples = noise.shape[:2]
        w = columns(noise)
        found = slopes(problem, theta, w)
        problem.usage.gradients += w.shape[1]
        first, start = by_actions(found)
        # a step's action changes its own cost and all later ones
        to_come = np.cumsum(found.cost[::-1], axis=0)[::-1][:-1].reshape(-1, repeats, samples)
        to_come = (to_come - to_come.mean(axis=2, keepdims=True)) * (samples / (samples - 1))
        drawn = w.reshape(*first.shape[:2], repeats, samples)
        zeroth = to_come[:, None] * drawn / problem.sigma
        apart = first.reshape(zeroth.shape)
        weight = _weight(zeroth.var(axis=3, ddof=1), apart.var(axis=3, ddof=1))[..., None]
        mixed = (weight * apart + (1 - weight) * zeroth).reshape(first.shape)
        # theta moves no first state here, see refuses
        result = per_repeat(by_theta(problem, found, mixed, start), noise).mean(axis=1)
        return result, {"weight": np.moveaxis(weight[..., 0], 2, 0).reshape(repeats, -1)}

    def unsupported_reason(self, program: Program) -> str | None:
        """Refuse ``per=action`` where no action of a step has noise of its own, or theta acts in another way too."""
        if self.per != "action":
            return None
        one_each = (
            isinstance(program, Rollout) and program.action_noise and program.scene.controls == program.scene.horizon
        )
        if one_each and not program.explicit and not program.surrogate:
            return None
        return (
            f"{self.name}[per=action] needs noise on the action of every step, and a theta that acts by actions alone"
        )


def _weight(v0: np.ndarray, v1: np.ndarray) -> np.ndarray:
    """Return v0 / (v0 + v1), 1/2 where both are 0 and any weight is right."""
    total = v0 + v1
    return np.asarray(np.divide(v0, total, out=np.full_like(total, 0.5), where=total > 0))


def _controls(program: Program) -> int:
    """Return how many coordinates of theta belong to one step: its controls, or all of theta."""
    scene = program.scene
    return scene.n_u if isinstance(scene, MechanicalScene) and scene.open_loop else program.dim


def _summed(variances: np.ndarray, part: int) -> np.ndarray:
    """Return variances ``(R, d)`` replaced by the sums over parts of that many neighbours."""
    sums = variances.reshape(len(variances), -1, part).sum(axis=2)
    return np.repeat(sums, part, axis=1)
