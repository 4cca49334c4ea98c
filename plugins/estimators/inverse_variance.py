"""Inverse-variance weighting of first and zeroth order."""

from dataclasses import dataclass

import numpy as np

from bench.model import Auxiliaries, DiagnosticEstimator, Problem, halves


@dataclass(frozen=True)
class InverseVariance(DiagnosticEstimator):
    """Approximates grad J_sigma with the fobg and zobg means weighted by their inverse variances, per coordinate.

    The weights are v0 / (v0 + v1) and v1 / (v0 + v1) on independent halves of the samples (total propagation, Parmas et
    al. 2018), the zeroth order with the mean cost of the other samples as baseline, as there. Requires costs, gradients and scores. It favours the mean with the lower variance, even if that mean is
    wrong. Biased at finite N, since the weights depend on the samples. Reports the first-order ``weight``.
    """

    name = "inverse_variance"
    revision = 2
    needs = frozenset({"value", "grad", "score"})
    unbiased = False
    in_units = True
    least_samples = 4
    diagnostics = ("weight",)

    def estimate_with_diagnostics(
        self, problem: Problem, theta: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, Auxiliaries]:
        """Return the estimates and the first-order weights, each ``(R, d)``."""
        first, zeroth = halves(problem, theta, noise, self.design(problem.program, noise.shape[1]).unit, leave_out=True)
        v1 = first.var(axis=1, ddof=1) / first.shape[1]
        v0 = zeroth.var(axis=1, ddof=1) / zeroth.shape[1]
        total = v0 + v1
        # if both variances are 0, any weight is correct
        weight = np.divide(v0, total, out=np.full_like(total, 0.5), where=total > 0)
        return weight * first.mean(axis=1) + (1 - weight) * zeroth.mean(axis=1), {"weight": weight}
