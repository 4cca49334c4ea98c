"""Interpolation of first and zeroth order with a confidence test."""

from dataclasses import dataclass

import numpy as np

from bench.model import Estimator, Problem, halves, param


@dataclass(frozen=True)
class AlphaOrder(Estimator):
    """Approximates grad J_sigma with a fobg + (1 - a) zobg from independent halves of the samples (Suh et al. 2022).

    With v1, v0 the variances of the two means, a = v0 / (v1 + v0) when the zeroth-order mean is known to within
    gamma, capped so that |a (fobg - zobg)| <= gamma - eps; a = 0 when it is not. Confidence radius
    eps = sqrt(2 V ln((d+1)/delta) / N) + (2 L / 3 N) ln((d+1)/delta), V the per-sample zeroth-order variance.
    Requires costs, gradients and scores. Biased by at most about gamma, since a depends on the samples.
    """

    name = "alpha_order"
    needs = frozenset({"value", "grad", "score"})
    adds_explicit = True
    unbiased = False

    gamma: float = param(1.0, "accuracy asked of the zeroth-order mean, in units of the gradient", positive=True)
    delta: float = param(0.05, "failure probability of the confidence radius", positive=True, high=1.0)
    bound: float | None = param(None, "L, bound on |zeroth-order term|; null: the largest seen", positive=True)

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return estimates with one interpolation weight per repeat."""
        first, zeroth = halves(problem, theta, noise)
        n = zeroth.shape[1]
        fobg, zobg = first.mean(axis=1), zeroth.mean(axis=1)
        per_sample = zeroth.var(axis=1, ddof=1).sum(axis=-1)
        v0 = per_sample / n
        v1 = first.var(axis=1, ddof=1).sum(axis=-1) / first.shape[1]
        largest = np.linalg.norm(zeroth, axis=-1).max(axis=1) if self.bound is None else self.bound
        log_term = np.log((zeroth.shape[2] + 1) / self.delta)
        eps = np.sqrt(2 * per_sample * log_term / n) + 2 * largest / (3 * n) * log_term
        total = v0 + v1
        # with both variances 0 any weight is right
        alpha = np.divide(v0, total, out=np.ones_like(total), where=total > 0)
        distance = np.linalg.norm(fobg - zobg, axis=-1)
        room = np.maximum(self.gamma - eps, 0.0)
        cap = np.divide(room, distance, out=np.full_like(distance, np.inf), where=distance > 0)
        alpha = np.where(eps > self.gamma, 0.0, np.minimum(alpha, cap))[:, None]
        return alpha * fobg + (1 - alpha) * zobg
