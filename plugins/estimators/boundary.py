"""First order inside the branches of the cost, plus a boundary term for each declared event."""

from dataclasses import dataclass

import numpy as np

from bench.model import Problem, Program, SampleMean, events_of, param, undeclared_jumps


@dataclass(frozen=True)
class Boundary(SampleMean):
    """Approximates grad J_sigma with df/dtheta + sum_k phi(c_k) dc_k/dtheta (f with event k - f without it).

    Event k happens where a normal number of the sample is below c_k. Both costs are at the boundary: that number is
    c_k, and all other noise is the sample's. It is the reparameterization gradient with its correction term of Lee, Yu,
    Yang 2018 (density at the boundary, times the boundary's velocity, times the jump), for noise rotated so that one
    coordinate is normal to the boundary, and summed over all events, where their code samples one of them. For a
    discrete event it is dp/dtheta times the jump. Needs a scene that declares its events, or a continuous cost, on
    which it equals ``fobg``. Requires costs and gradients, 2 rollouts per sample and event. Unbiased.

    The costs are ``gap`` on either side of the boundary, which float64 resolves. In float32 it should be about 1e-3.
    """

    name = "boundary"
    needs = frozenset({"value", "grad"})
    unbiased_at_discontinuities = True

    gap: float = param(
        1e-6, "distance of both costs from the boundary, in standard deviations of the noise", positive=True
    )

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        total = problem.grad(theta, w)
        for direction, limit, slope in zip(*events_of(problem, theta, w), strict=True):
            at_limit = w + direction[:, None] * (limit - direction @ w)
            apart = self.gap * direction[:, None]
            jump = problem.value(theta, at_limit - apart) - problem.value(theta, at_limit + apart)
            total = total + np.exp(-0.5 * limit**2) / np.sqrt(2.0 * np.pi) * slope * jump
        return total

    def own_refusal(self, program: Program) -> str | None:
        missing = undeclared_jumps(program)
        return None if missing is None else f"{self.name} needs all jumps of the cost: {missing}"
