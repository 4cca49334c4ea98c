"""Zeroth order of the cost minus a fitted quadratic model, plus the model's own gradient."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bench.model import Auxiliaries, DiagnosticEstimator, Problem, columns, param, per_repeat


@dataclass(frozen=True)
class QuadraticModel(DiagnosticEstimator):
    """Approximates grad J_sigma with the mean of (f - q) w / sigma plus the gradient of E q(w), q quadratic in w.

    For q = c + g . w + w' H w / 2 the mean of q(w) w is g, so the sum is unbiased for any cost and any q that does not
    depend on w. Each sample's q is the least-squares fit to the other samples, by the formulas of leave-one-out
    regression. Only the part of f that no q fits has variance: none for a quadratic cost, 42 per sample for w^3 in units
    of 1 / sigma^2, against 96 for cost times score. Schramm et al. 2026 split an objective into a quadratic model and a
    remainder for a path integral. This control variate and its fit are derived here, and hold by the closed forms of its
    tests.

    Samples are fitted in blocks of up to ``block``. A fit has fewer than half as many coefficients as samples: all of H,
    or its diagonal, or g only, or c only, whichever is the largest. Just above a number of samples that allows more
    coefficients, or that takes one more block, the error is larger: on a quadratic cost of 14 variables it is rounding
    at N = 256, and 0.2 to 0.5 of the gradient at N = 257, whose two blocks allow no H. Requires only costs, with noise on
    theta, and at least 4 samples. Reports as ``explained`` the share of the variance of f that the model predicts for
    samples outside its fit.
    """

    name = "quadratic_model"
    needs_noise_on_theta = True
    needs_directions = True
    unbiased_at_discontinuities = True
    couples_samples = True
    needs_independent_samples = True
    least_samples = 4
    diagnostics = ("explained",)

    block: int = param(256, "largest number of samples in one fit", low=4)

    def estimate_with_diagnostics(
        self, problem: Problem, theta: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, Auxiliaries]:
        """Return the estimates ``(R, d)``, and ``explained``, ``(R,)``."""
        count = noise.shape[1]
        f = per_repeat(problem.value(theta, columns(noise)), noise)
        total = np.zeros((len(noise), problem.dim))
        unexplained = np.zeros(len(noise))
        for part in np.array_split(np.arange(count), math.ceil(count / self.block)):
            w = noise[:, part, : problem.dim]
            gradients, errors = _left_out(w, f[:, part])
            total += (errors[..., None] * w).sum(axis=1) + gradients
            unexplained += (errors**2).sum(axis=1)
        spread = f.var(axis=1) * count
        explained = 1.0 - np.divide(unexplained, spread, out=np.zeros_like(spread), where=spread > 0)
        return total / (count * problem.sigma), {"explained": explained}


def _left_out(w: np.ndarray, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sum over samples of g without that sample, ``(R, d)``, and each sample's error without it, ``(R, n)``.

    With X = QU the features and e the residuals of the whole fit, the error of sample n is r_n = e_n / (1 - |Q_n|^2),
    and its coefficients are the coefficients of the whole fit minus U^-1 Q_n r_n.
    """
    n, d = w.shape[1:]
    x = np.concatenate([np.ones((*w.shape[:2], 1)), *_features(w)], axis=2)
    q, u = np.linalg.qr(x)
    f = f - f.mean(axis=1, keepdims=True)
    along = np.einsum("rnk,rn->rk", q, f)
    errors = (f - np.einsum("rnk,rk->rn", q, along)) / (1.0 - (q**2).sum(axis=2))
    summed = n * along - np.einsum("rnk,rn->rk", q, errors)
    coefficients = np.linalg.solve(u, summed[..., None])[..., 0]
    gradient = np.zeros((len(w), d))
    if x.shape[2] > d:
        gradient[:] = coefficients[:, 1 : d + 1]
    return gradient, errors


def _features(w: np.ndarray) -> Iterator[np.ndarray]:
    """Yield w, the squares and the products of its coordinates ``(R, n, k)``, as many as n samples allow."""
    n, d = w.shape[1:]
    room = n // 2 - 2  # with fewer spare samples, coefficients have no finite variance
    if d <= room:
        yield w
    if 2 * d <= room:
        yield w**2 - 1.0
    if (d * (d + 3)) // 2 <= room:
        i, j = np.triu_indices(d, 1)
        yield w[..., i] * w[..., j]
