"""First-order batch gradient."""

from dataclasses import dataclass

import numpy as np

from bench.model import Problem, SampleMean


@dataclass(frozen=True)
class Fobg(SampleMean):
    """Approximates grad J_sigma with the mean of df(theta, w)/dtheta.

    Requires gradients. Unbiased for continuous costs; misses every jump of the cost (Suh et al. 2022).
    """

    name = "fobg"
    needs = frozenset({"grad"})

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return df/dtheta of each sample, ``(d, B)``."""
        return problem.grad(theta, w)
