"""Measure-valued (weak) derivative of the Gaussian noise."""

from dataclasses import dataclass

import numpy as np

from bench.model import Problem, SampleMean


@dataclass(frozen=True)
class MeasureValued(SampleMean):
    """Approximates grad J_sigma with (f(w_i = r) - f(w_i = -r)) / (sigma sqrt(2 pi)) for every coordinate i.

    The derivative of a normal density by its mean is a difference of two Rayleigh densities. Both terms use the same
    Rayleigh-distributed r (coupled), and the other coordinates keep their noise. Needs 2 d rollouts per sample.
    Requires only costs, with noise on theta. Unbiased for any cost, and of variance 0 for a symmetric cost
    (Mohamed et al. 2020, section 6).
    """

    name = "measure_valued"
    needs_noise_on_theta = True
    unbiased_at_discontinuities = True

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        from scipy.special import log_ndtr

        radius = np.sqrt(-2.0 * log_ndtr(w))
        rows = []
        for i in range(problem.dim):
            moved = np.array(w)
            moved[i] = radius[i]
            ahead = problem.value(theta, moved)
            moved[i] = -radius[i]
            rows.append(ahead - problem.value(theta, moved))
        return np.stack(rows) / (problem.sigma * np.sqrt(2.0 * np.pi))
