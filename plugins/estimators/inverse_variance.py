"""Inverse-variance weighting of first and zeroth order."""

from dataclasses import dataclass

import numpy as np

from bench.contracts import Estimator, Problem, columns, per_repeat


@dataclass(frozen=True)
class InverseVariance(Estimator):
    """Approximates grad J_sigma with, per coordinate, the fobg and zobg means weighted by 1 / their variances.

    Weights v0 / (v0 + v1) and v1 / (v0 + v1) on independent halves of the samples (total propagation, Parmas et
    al. 2018). Requires costs, gradients and scores. Follows whichever has the lower variance, right or wrong; the
    weights depend on the samples, so it is biased at finite N too.
    """

    name = "inverse_variance"
    needs = frozenset({"value", "grad", "score"})
    unbiased = False

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """One weight for each repeat and coordinate."""
        first, zeroth = halves(problem, theta, noise)
        v1 = first.var(axis=1, ddof=1) / first.shape[1]
        v0 = zeroth.var(axis=1, ddof=1) / zeroth.shape[1]
        total = v0 + v1
        weight = np.divide(v0, total, out=np.full_like(total, 0.5), where=total > 0)
        return weight * first.mean(axis=1) + (1 - weight) * zeroth.mean(axis=1)


def halves(problem: Problem, theta: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First-order terms of the first half of the samples and zeroth-order ones of the rest, each ``(R, N/2, d)``.

    The zeroth-order terms are (f - f at w = 0) times the score. Raises ValueError below 4 samples.
    """
    half = noise.shape[1] // 2
    if half < 2:
        raise ValueError(f"needs at least 4 samples, got {noise.shape[1]}")
    a, b = noise[:, :half], noise[:, half:]
    first = per_repeat(problem.grad(theta, columns(a)), a)
    w = columns(b)
    cost = problem.value(theta, w) - problem.value(theta, np.zeros((w.shape[0], 1)))
    return first, per_repeat(cost * problem.score(theta, w), b)
