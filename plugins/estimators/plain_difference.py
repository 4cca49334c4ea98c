"""Central differences of the cost without noise."""

from dataclasses import dataclass

import numpy as np

from bench.model import Estimator, Problem, central_differences, columns, param

CUBE_ROOT = float(np.cbrt(np.finfo(np.float64).eps))
"""Relative step at which rounding and truncation errors of a smooth cost balance."""
MOST_NUMBERS = 1 << 24
"""Most numbers in the points of one call (128 MiB)."""


@dataclass(frozen=True)
class PlainDifference(Estimator):
    """Approximates grad J_sigma with (f(theta + h_i e_i) - f(theta - h_i e_i)) / 2h_i at w = 0: ``plain`` from costs only.

    The step is h_i = ``step`` max(1, abs(theta_i)), by default with the cube root of the unit roundoff (Nocedal, Wright 2006,
    section 8.1; scaled as in SciPy's ``approx_derivative``). The scene's own noise is the first sample's, the same in all
    costs. 2 d rollouts per estimate, whatever N. Requires only costs. Biased like ``plain``.
    """

    name = "plain_difference"
    unbiased = False
    fixed_work = True

    step: float = param(CUBE_ROOT, "h_i / max(1, abs(theta_i)); in float32 about 5e-3", positive=True)

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the differences at w = 0 and each repeat's first draw of the scene's own noise, ``(R, d)``."""
        step = self.step * np.maximum(1.0, np.abs(theta))
        w = problem.centred(columns(noise[:, :1]))
        block = min(problem.block, MOST_NUMBERS // (len(theta) + len(w)))
        return central_differences(problem.value, theta[:, None], w, step, block).T
