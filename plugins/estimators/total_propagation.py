"""First and zeroth order, weighted per time step."""

from dataclasses import dataclass

import numpy as np

from bench.model import (
    Auxiliaries,
    DiagnosticEstimator,
    MechanicalScene,
    Problem,
    Program,
    Rollout,
    adjoint,
    against_others,
    by_actions,
    by_theta,
    columns,
    first_order,
    param,
    per_repeat,
    per_unit,
    slopes,
)


@dataclass(frozen=True)
class TotalPropagation(DiagnosticEstimator):
    """Approximates grad J_sigma with both orders from the same samples, weighted for each step's controls.

    The weights are v0 / (v0 + v1) and v1 / (v0 + v1), v the summed variances of one step's part of theta: if a gradient
    explodes backwards through time, early steps use the zeroth order and late steps the first. ``per=step`` weights the
    controls of a step together (Parmas et al. 2018, total propagation), ``per=control`` each one separately. If theta
    is not a sequence of controls, it is one part. Both use the whole cost in the zeroth-order terms.

    ``per=action`` weights the derivatives by each action of each step before the chain rule to theta, so that it works
    for a policy too. It uses the cost-to-go minus its mean over the other samples (Onoda et al. 2026, IVW-H, according
    to their abstract: inverse variance per step; they use a critic for the cost-to-go). It needs noise on the actions.
    Unlike in the source of 2018, no weight acts within the backward pass.

    Requires costs, gradients and scores. Biased: the weights depend on the samples and favour low variance, even of a
    wrong mean. Reports the first-order ``weight`` of each coordinate, or of each action.
    """

    name = "total_propagation"
    revision = 2
    uses = (adjoint,)
    needs = frozenset({"value", "grad", "score"})
    unbiased = False
    in_units = True
    least_samples = 2
    diagnostics = ("weight",)

    per: str = param("step", "the unit with a common weight", choices=("step", "control", "action"))

    @property
    def needs_independent_samples(self) -> bool:  # type: ignore[override]
        """True for ``per=action``."""
        return self.per == "action"

    def estimate_with_diagnostics(
        self, problem: Problem, theta: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, Auxiliaries]:
        """Return the estimates ``(R, d)`` and the first-order weights.

        The weights are ``(R, d)``, or ``(R, horizon * n_u)`` with ``per=action``.
        """
        if self.per == "action":
            return self._per_action(problem, theta, noise)
        unit = self.design(problem.program, noise.shape[1]).unit
        orders = first_order(problem, theta, noise), against_others(problem, theta, noise, unit)
        first, zeroth = (per_unit(terms, unit) for terms in orders)
        part = 1 if self.per == "control" else _controls(problem.program)
        v1, v0 = (_summed(terms.var(axis=1, ddof=1), part) for terms in (first, zeroth))
        weight = _weight(v0, v1)
        return weight * first.mean(axis=1) + (1 - weight) * zeroth.mean(axis=1), {"weight": weight}

    def _per_action(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, Auxiliaries]:
        repeats, samples = noise.shape[:2]
        w = columns(noise)
        path = slopes(problem, theta, w)
        problem.usage.gradients += w.shape[1]
        first, start = by_actions(path)
        # a step's action affects its own cost and all later costs
        cost_to_go = np.cumsum(path.cost[::-1], axis=0)[::-1][:-1].reshape(-1, repeats, samples)
        cost_to_go = (cost_to_go - cost_to_go.mean(axis=2, keepdims=True)) * (samples / (samples - 1))
        actions_noise = w[: len(w) - problem.program.exogenous].reshape(*first.shape[:2], repeats, samples)
        zeroth = cost_to_go[:, None] * actions_noise / problem.sigma
        by_action = first.reshape(zeroth.shape)
        weight = _weight(zeroth.var(axis=3, ddof=1), by_action.var(axis=3, ddof=1))[..., None]
        mixed = (weight * by_action + (1 - weight) * zeroth).reshape(first.shape)
        # theta does not move the initial state here, see own_refusal
        result = per_repeat(by_theta(problem, path, mixed, start), noise).mean(axis=1)
        return result, {"weight": np.moveaxis(weight[..., 0], 2, 0).reshape(repeats, -1)}

    def own_refusal(self, program: Program) -> str | None:
        """Return the reason if ``per=action`` lacks noise on every action, or theta acts otherwise; else None."""
        if self.per != "action":
            return None
        one_each = (
            isinstance(program, Rollout) and program.action_noise and program.scene.controls == program.scene.horizon
        )
        if one_each and not program.score_refusal and not program.surrogate:
            return None
        return f"{self.name}[per=action] needs noise on the action of every step, and a theta that acts through the actions only"


def _weight(v0: np.ndarray, v1: np.ndarray) -> np.ndarray:
    """Return v0 / (v0 + v1), or 1/2 if both are 0, where any weight is correct."""
    total = v0 + v1
    return np.divide(v0, total, out=np.full_like(total, 0.5), where=total > 0)


def _controls(program: Program) -> int:
    """Return the number of coordinates of theta per step: n_u for a sequence of controls, otherwise d."""
    scene = program.scene
    return scene.n_u if isinstance(scene, MechanicalScene) and scene.open_loop else program.dim


def _summed(variances: np.ndarray, part: int) -> np.ndarray:
    """Return variances ``(R, d)`` in which each is replaced by the sum over its group of ``part`` neighbours."""
    sums = variances.reshape(len(variances), -1, part).sum(axis=2)
    return np.repeat(sums, part, axis=1)
