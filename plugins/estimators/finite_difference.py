"""Central differences of the sample-mean cost."""

from dataclasses import dataclass

import numpy as np

from bench.model import Problem, SampleMean, param


@dataclass(frozen=True)
class FiniteDifference(SampleMean):
    """Approximates grad J_sigma by central differences of the mean cost under common random numbers.

    It needs 2 d rollouts per sample and has a bias of order step^2. Across a jump of the cost it is unbiased for
    J_sigma averaged over one step, with a variance that grows as 1/step (Glasserman 2003, ch. 7). Requires only costs.
    """

    name = "finite_difference"
    unbiased = False
    unbiased_at_discontinuities = False

    step: float = param(1e-3, "half the distance of the two points, in units of theta", positive=True)

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return (f(theta + h e_i, w) - f(theta - h e_i, w)) / 2h for every coordinate i, ``(d, B)``."""
        rows = []
        for i in range(problem.dim):
            shift = np.zeros((problem.dim, 1))
            shift[i] = self.step
            rows.append(problem.displaced(shift, theta, w) - problem.displaced(-shift, theta, w))
        return np.stack(rows) / (2 * self.step)
