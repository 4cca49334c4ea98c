"""Stochastic derivative of discrete events: a weight times the change of the cost along an alternative path."""

from dataclasses import dataclass

import numpy as np

from bench.model import EventScene, Problem, Program, SampleMean, events_of, undeclared_jumps


@dataclass(frozen=True)
class StochasticDerivative(SampleMean):
    """Approximates grad J_sigma with df/dtheta + sum_k weight_k (f with event k changed - f).

    The changed path has the same noise, so later events may change too. With p the probability of event k given the
    other noise, the weight is max(0, dp/dtheta_i) / (1 - p) where it did not happen, and max(0, -dp/dtheta_i) / p where
    it did: for each coordinate of theta, an event changes only in the direction in which its probability moves. These
    are the rules of Arya, Schauer, Schaefer, Rackauckas 2022 for a Bernoulli variable, as in the code of StochasticAD.jl.
    Their code takes one alternative path by chance, here all are followed. Needs a scene that declares discrete events.
    Requires costs and gradients, 1 rollout per sample and 1 more per event. Unbiased.
    """

    name = "stochastic_derivative"
    needs = frozenset({"value", "grad"})
    unbiased_at_discontinuities = True

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        from scipy.special import log_ndtr

        total, cost = problem.grad(theta, w), problem.value(theta, w)
        for direction, limit, slope in zip(*events_of(problem, theta, w), strict=True):
            number = direction @ w
            side = np.where(number < limit, 1.0, -1.0)  # 1 if the event happened
            changed = w + direction[:, None] * (limit + side - number)
            # phi(c) over the probability of what happened: Phi(c) or Phi(-c)
            ratio = np.exp(-0.5 * limit**2 - log_ndtr(side * limit)) / np.sqrt(2.0 * np.pi)
            weight = ratio * np.maximum(0.0, -side * slope)
            total = total + weight * (problem.value(theta, changed) - cost)
        return total

    def own_refusal(self, program: Program) -> str | None:
        scene = program.scene
        if not (isinstance(scene, EventScene) and scene.discrete):
            return f"{self.name} needs a scene that declares discrete events, and {scene.name} does not"
        missing = undeclared_jumps(program)
        return None if missing is None else f"{self.name} needs all jumps of the cost: {missing}"
