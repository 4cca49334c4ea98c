"""Zeroth order with the baseline of lowest variance for each coordinate."""

from dataclasses import dataclass

import numpy as np

from bench.model import Estimator, Problem, columns, per_repeat, sums_of_units


@dataclass(frozen=True)
class OptimalBaseline(Estimator):
    """Approximates grad J_sigma with the mean of (f - b_i) s_i, s the score, b_i = E[f s_i^2] / E[s_i^2].

    b_i has the lowest variance of all constant baselines of coordinate i (Greensmith et al. 2004; Peters, Schaal 2008).
    Each sample's b_i is computed from the samples that are drawn independently of it, so the result is unbiased for any cost. It is the mean of their f
    where all their scores are 0. On a + g w + h w^2
    with w standard normal, the variance per sample is 2 g^2 + 6 h^2 in units of 1 / sigma^2, against 2 g^2 + 10 h^2
    with the mean of f as baseline. Requires costs and scores, and at least 2 samples.
    """

    name = "optimal_baseline"
    needs = frozenset({"value", "score"})
    unbiased_at_discontinuities = True
    in_units = True
    least_samples = 2

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the mean of the terms over samples, ``(R, d)``."""
        count = noise.shape[1]
        w = columns(noise)
        f = per_repeat(problem.value(theta, w), noise)[..., None]
        score = per_repeat(problem.score(theta, w), noise)
        # a constant added to f is removed by every baseline, and a small f has smaller rounding errors
        centred = f - f.mean(axis=1, keepdims=True)
        terms = centred * score
        product, square = terms * score, score**2
        unit = self.design(problem.program, count).unit
        above, below = (of.sum(axis=1, keepdims=True) - sums_of_units(of, unit) for of in (product, square))
        # centred costs sum to 0, so this is the mean of the others: a baseline must not depend on the own unit
        baseline = np.zeros_like(above) - sums_of_units(centred, unit) / (count - unit)
        np.divide(above, below, out=baseline, where=below > 0)
        return (terms - baseline * score).mean(axis=1)
