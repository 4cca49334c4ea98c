"""The gradient without noise."""

from dataclasses import dataclass

import numpy as np

from bench.model import Estimator, Problem, columns


@dataclass(frozen=True)
class Plain(Estimator):
    """Approximates grad J_sigma with df/dtheta at w = 0: the gradient of one rollout without noise.

    It is the usual gradient through a differentiable simulator, in model predictive control and system identification
    (Hu et al. 2020). The scene's own noise, such as a random start, is the first sample's. One gradient per estimate,
    whatever N. Requires gradients. Biased by what the noise of J_sigma smooths; of variance 0
    unless the scene has noise of its own.
    """

    name = "plain"
    needs = frozenset({"grad"})
    unbiased = False
    fixed_work = True

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the gradient at w = 0 and each repeat's first draw of the scene's own noise, ``(R, d)``."""
        return problem.grad(theta, problem.centred(columns(noise[:, :1]))).T
