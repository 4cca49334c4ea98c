"""Tests whether a fitted model explains a record: size, outliers, correlation and structure of the residuals.

Under a right model with independent normal noise, the residuals of a fit are normal numbers projected out of the
columns of the Jacobian, to first order. All tests use simulated residuals of that law as their quantiles, so that the
whole set has the stated rate of false alarms, however strongly the tests depend on each other. Sources: Ljung and Box
1978 (sums of squared autocorrelations), Breusch and Pagan 1980 (score tests of terms that the model lacks), Andrews 1991
(covariances under correlated noise).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

DRAWS = 2000
"""Simulated residuals that determine the quantiles."""
LAGS = 10
"""Lags of the autocorrelations that are tested together."""
WAVES = 8
"""Slowest cosines along the record that are tested together."""
LEVEL = 0.05
"""Rate of false alarms of all tests of a record together."""
RESOLVED = 1e-6
"""Share of a term's effect on the record that must remain beside the parameters for the term to be tested."""
FEWEST = 20
"""Fewest measurements per channel for tests of correlation and of slow changes."""


@dataclass(frozen=True)
class Adequacy:
    """Whether a model explains a record."""

    probability: float
    """Share of records of a right model that look worse, over all tests."""
    findings: tuple[str, ...]
    """What contradicts the model, the strongest contradiction first; empty if nothing does."""

    @property
    def is_explained(self) -> bool:
        """Whether no test contradicts the model at the 5% level of all tests together."""
        return self.probability > LEVEL

    def sentence(self) -> str:
        """Return what follows for the intervals of the parameters; empty where the record is explained."""
        if self.is_explained:
            return ""
        return (
            f"the model does not explain the record (p = {self.probability:.2g}): {'; '.join(self.findings)}. The intervals "
            "do not hold"
        )


def judge(
    residual: np.ndarray,
    jacobian: np.ndarray,
    channels: int,
    terms: Mapping[str, np.ndarray] | None = None,
    seed: int = 0,
) -> Adequacy:
    """Return whether standardised residuals ``(m,)`` of a fit with the Jacobian ``(m, p)`` can come from a right model.

    The measurements are ``channels`` numbers per step, step by step. ``terms`` are derivatives ``(m,)`` of the
    standardised measurements with respect to effects that the model lacks, by name.
    """
    basis, _ = np.linalg.qr(jacobian)
    rank = int((np.linalg.svd(jacobian, compute_uv=False) > 1e-9 * np.linalg.norm(jacobian)).sum())
    if rank < basis.shape[1]:
        basis = np.linalg.svd(jacobian, full_matrices=False)[0][:, :rank]
    names, rows = [], []
    for name, effect in (terms or {}).items():
        rest = effect - basis @ (basis.T @ effect)
        length = np.linalg.norm(rest)
        if np.isfinite(length) and length > RESOLVED * np.linalg.norm(effect) > 0.0:
            names.append(name)
            rows.append(rest / length)
    directions = np.array(rows).reshape(-1, residual.size)
    random = np.random.default_rng([seed, 0x61646571])
    noise = random.standard_normal((DRAWS, residual.size))
    noise -= (noise @ basis) @ basis.T
    every = _statistics(np.concatenate([residual[None], noise]), directions, channels)
    # the share of simulated residuals with a larger statistic, for the record and for every simulated one
    own, others = every[:, 0], every[:, 1:]
    ordered = np.sort(others, axis=1)
    tail = np.array(
        [
            (DRAWS - np.searchsorted(row, values) + 1.0) / (DRAWS + 1.0)
            for row, values in zip(ordered, every, strict=True)
        ]
    )
    least = tail.min(axis=0)
    probability = float(((least[1:] <= least[0]).sum() + 1.0) / (DRAWS + 1.0))
    findings = []
    if probability <= LEVEL:
        series = residual.reshape(-1, channels)
        for k in np.argsort(tail[:, 0], kind="stable"):
            if tail[k, 0] <= LEVEL / len(every):
                findings.append(_words(int(k), residual, series, own, names, directions))
    return Adequacy(probability, tuple(findings) or ("its residuals are unlikely",) * (probability <= LEVEL))


def pool(residuals: np.ndarray, jacobians: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residual ``(m,)`` and Jacobian ``(m, p)`` of all records together, from those of each, ``(m, R)`` and ``(m, p, R)``.

    Noise keeps its size in the sum of independent records over sqrt(R). The effect of what the model lacks grows by sqrt(R).
    """
    return residuals.sum(axis=1) / np.sqrt(residuals.shape[1]), jacobians.mean(axis=2)


def _statistics(residuals: np.ndarray, directions: np.ndarray, channels: int) -> np.ndarray:
    """Return the statistics of residuals ``(n, m)``, ``(k, n)``: size, the largest, correlation, slow changes, each term's."""
    n, m = residuals.shape
    series = residuals.reshape(n, m // channels, channels)
    length = series.shape[1]
    parts = [np.square(residuals).sum(axis=1), np.abs(residuals).max(axis=1)]
    if length >= FEWEST:
        power = np.square(series).sum(axis=1)
        correlations = np.zeros((n, channels))
        for lag in range(1, LAGS + 1):
            products = (series[:, lag:] * series[:, :-lag]).sum(axis=1)
            correlations += np.square(products / np.maximum(power, 1e-300)) / (length - lag)
        waves = np.cos(np.pi * np.arange(WAVES)[:, None] * (np.arange(length) + 0.5) / length)
        waves /= np.linalg.norm(waves, axis=1, keepdims=True)
        parts += [correlations.sum(axis=1), np.square(np.einsum("wl,nlc->nwc", waves, series)).sum(axis=(1, 2))]
    return np.array([*parts, *np.abs(residuals @ directions.T).T])


def _words(
    k: int, residual: np.ndarray, series: np.ndarray, own: np.ndarray, names: list[str], directions: np.ndarray
) -> str:
    tests = len(own) - len(names)
    if k == 0:
        return f"the residuals are {float(np.sqrt(np.square(residual).mean())):.3g} times the stated noise"
    if k == 1:
        return f"the largest residual is {float(np.abs(residual).max()):.2g} times the stated noise"
    if k < tests:
        rho = float(np.mean([np.corrcoef(c[1:], c[:-1])[0, 1] for c in series.T]))
        return (
            f"the residuals are correlated ({rho:.2g} between steps)"
            if k == 2
            else "the residuals change slowly over time"
        )
    name, size = names[k - tests], float(directions[k - tests] @ residual)
    return f"the residuals look like {name} that the model lacks ({abs(size):.1f} standard errors)"


def correlated_covariance(residual: np.ndarray, jacobian: np.ndarray, channels: int) -> np.ndarray:
    """Return the covariance of the estimates ``(p, p)`` under noise of any size that is correlated from step to step.

    Each channel's noise is an autoregression of order 1. Its coefficient is the residuals' correlation between steps,
    corrected for the bias (1 + 4 rho) / n and for the parameters, and its variance the residuals' own.
    """
    length, p = residual.size // channels, jacobian.shape[1]
    series = residual.reshape(length, channels)
    inverse = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-11, hermitian=True)
    gain = (inverse @ jacobian.T).reshape(p, length, channels)
    total = np.zeros((p, p))
    apart = np.abs(np.arange(length)[:, None] - np.arange(length))
    for c in range(channels):
        values = series[:, c]
        power = float(values @ values) / max(length - p / channels, 1.0)
        rho = float(values[1:] @ values[:-1]) / max(float(values @ values), 1e-300)
        rho = min(max(rho + (1.0 + 4.0 * rho + 2.0 * p / channels * (1.0 + rho) / 2.0) / length, 0.0), 0.99)
        # a fit absorbs part of slow noise, which lowers the variance of the residuals
        kernel = rho**apart
        free = length - float(
            np.einsum("pl,lk,pk->", gain[:, :, c], kernel, jacobian.reshape(length, channels, p)[:, c].T)
        )
        total += (power * length / max(free, 0.5 * length)) * gain[:, :, c] @ kernel @ gain[:, :, c].T
    return np.asarray(total)
