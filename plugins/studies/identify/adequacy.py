"""Tests whether a fitted model explains a record, what such tests can miss, and which covariance the residuals call for.

Under a right model with independent noise, the residuals of a fit are the noise projected out of the columns of the
Jacobian, to first order. All tests are calibrated together on simulated residuals, so that the whole set has the stated
rate of false alarms. Their noise is Student's t with the kurtosis of the record's own residuals, so that long tails are no
contradiction. Tests except that of the size use residuals over their own size.
Sources: Ljung and Box 1978 (sums of squared autocorrelations), Breusch and Pagan 1980 (score tests of terms that the
model lacks), Andrews 1991 (covariances under correlated noise).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.fft import dct
from scipy.linalg import toeplitz
from scipy.special import chdtri, ndtri, stdtrit

SIMULATIONS = 2000
"""Simulated residuals that determine the quantiles."""
LAGS = 10
"""Lags of the autocorrelations that are tested together."""
LEVEL = 0.05
"""Rate of false alarms of all tests of a record together."""
POWER = 0.95
"""Share of records in which a missing term of the size in :attr:`Adequacy.reach` is noticed."""
RESOLVED = 1e-6
"""Share of a term's effect on the record that must remain beside the parameters for the term to be tested."""
FEWEST = 20
"""Fewest measurements beyond the parameters for any test, and fewest per channel for tests along the record."""


@dataclass(frozen=True)
class Adequacy:
    """Whether a model explains a record."""

    probability: float
    """Share of records of a right model that look worse, over all tests; NaN if the record is too short for any test."""
    contradictions: Mapping[str, float] = field(default_factory=dict)
    """What contradicts the model, the strongest first, in units of the edge of its test."""
    reach: Mapping[str, float] = field(default_factory=dict)
    """By term that the model lacks, the size in units of the term that :data:`POWER` of the records show; inf: none does."""

    @property
    def is_explained(self) -> bool:
        """Whether no test contradicts the model at the 5% level of all tests together."""
        return self.probability > LEVEL


def judge(
    residual: np.ndarray,
    jacobian: np.ndarray,
    channels: int,
    terms: Mapping[str, np.ndarray],
    seed: int = 0,
    is_size_known: bool = True,
) -> Adequacy:
    """Return whether standardised residuals ``(m,)`` of a fit with the Jacobian ``(m, r)`` can come from a right model.

    The Jacobian has full rank. The measurements are ``channels`` numbers per step, step by step. ``terms`` are
    derivatives ``(m,)`` of the standardised measurements with respect to effects that the model lacks, by name. The size
    of the residuals is tested if ``is_size_known``.
    """
    m, free = residual.size, residual.size - jacobian.shape[1]
    if free < FEWEST or not residual.any():
        return Adequacy(np.nan)
    basis, _ = np.linalg.qr(jacobian)
    rests = {name: effect - basis @ (basis.T @ effect) for name, effect in terms.items()}
    lengths = {name: float(np.linalg.norm(rest)) for name, rest in rests.items()}
    seen = [name for name in rests if lengths[name] > RESOLVED * np.linalg.norm(terms[name])]
    directions = {name: rests[name] / lengths[name] for name in seen}
    # all residuals but the largest have the tails of the noise; their excess kurtosis is about half of that of the noise
    freedom = 4.0 + 3.0 / max(_excess(np.sort(np.abs(residual))[:-1]), 1e-3)
    noise = np.random.default_rng([seed, 0x61646571]).standard_t(freedom, (SIMULATIONS, m)) * np.sqrt(
        1.0 - 2.0 / freedom
    )
    noise -= (noise @ basis) @ basis.T
    statistics = _statistics(np.concatenate([residual[None], noise]), directions, channels, free)
    if not is_size_known:
        del statistics["noise"]
    every = np.array(list(statistics.values()))
    # the share of simulated residuals with a larger statistic, for the record and for every simulated one
    tail = np.array(
        [(SIMULATIONS - np.searchsorted(np.sort(row[1:]), row) + 1.0) / (SIMULATIONS + 1.0) for row in every]
    )
    least = tail.min(axis=0)
    probability = float(((least[1:] <= least[0]).sum() + 1.0) / (SIMULATIONS + 1.0))
    edge = np.quantile(least[1:], LEVEL)
    # strengths are in units of the edge of each test
    strengths = every[:, 0] / np.quantile(every[:, 1:], 1.0 - edge, axis=1)
    order = [k for k in np.argsort(-strengths) if tail[k, 0] <= edge and probability <= LEVEL]
    contradictions = {list(statistics)[k]: float(strengths[k]) for k in order}
    # a term of this length beside the parameters exceeds the edge in the stated share of records
    size = np.linalg.norm(residual) / np.sqrt(free)
    least_length = float(size) * float(ndtri(POWER) - ndtri(edge / 2.0))
    reach = {name: least_length / lengths[name] if name in directions else np.inf for name in rests}
    return Adequacy(probability, contradictions, reach)


def _statistics(
    residuals: np.ndarray, directions: Mapping[str, np.ndarray], channels: int, free: int
) -> dict[str, np.ndarray]:
    """Return the statistics of residuals ``(n, m)``, each ``(n,)``: size, the largest, along the record, and of terms."""
    n, m = residuals.shape
    square = np.square(residuals).sum(axis=1) / free
    own = residuals / np.sqrt(square)[:, None]
    parts = {"noise": np.abs(np.log(square)), "largest residual": np.abs(own).max(axis=1)}
    series = own.reshape(n, m // channels, channels)
    length = series.shape[1]
    if length >= FEWEST:
        power = np.abs(np.fft.rfft(series, 2 * length, axis=1)) ** 2
        lags = np.arange(1, LAGS + 1)[:, None]
        products = np.fft.irfft(power, axis=1)[:, : LAGS + 1]
        correlations = np.square(products[:, 1:] / np.maximum(products[:, :1], 1e-300)) / (length - lags)
        parts["correlation"] = correlations.sum(axis=(1, 2))
        # slowest cosines along the record that are tested together
        parts["slow change"] = np.square(dct(series, axis=1, norm="ortho")[:, :8]).sum(axis=(1, 2))
    return parts | {name: np.abs(own @ direction) for name, direction in directions.items()}


def _excess(residual: np.ndarray) -> float:
    """Return the kurtosis of residuals ``(m,)`` above that of normal numbers."""
    return float(np.mean(residual**4) / max(np.mean(residual**2) ** 2, 1e-300)) - 3.0


def variances(
    residual: np.ndarray, jacobian: np.ndarray, channels: int, is_size_known: bool = True
) -> tuple[np.ndarray, str, float]:
    """Return variances of the estimates ``(r,)``, the noise that they allow for, and the quantile of 95% intervals.

    Noise of the ``stated`` size; of ``own size``, that of the residuals, if none is stated or theirs differs from it; or
    ``correlated``, if the residuals are from step to step. Tests at the 5% level decide. Each channel's correlated noise is
    an autoregression of order 1. Its coefficient is the residuals' correlation between steps, corrected for the bias
    (1 + 4 rho) / n and for the parameters, and its variance the residuals' own.
    """
    m, r = jacobian.shape
    length, free, per_channel = m // channels, m - r, r / channels
    variance = np.diag(np.linalg.inv(jacobian.T @ jacobian))
    square = float(residual @ residual) / free if free else 1.0
    error = np.sqrt((2.0 + 2.0 * max(_excess(residual), 0.0)) / m)
    is_own = not is_size_known or (free >= FEWEST and abs(np.log(max(square, 1e-300))) > ndtri(0.975) * error)
    quantile = float(stdtrit(free, 0.975) if is_own else ndtri(0.975))
    if is_own:
        variance = variance * square
    series = residual.reshape(length, channels)
    power = np.square(series).sum(axis=0)
    correlations = (series[1:] * series[:-1]).sum(axis=0) / np.maximum(power, 1e-300)
    if min(length, free) < FEWEST or length * float(correlations @ correlations) <= chdtri(channels, LEVEL):
        return variance, "own size" if is_own else "stated", quantile
    gain, slopes = np.linalg.pinv(jacobian).reshape(r, length, channels), jacobian.reshape(length, channels, r)
    total = np.zeros(r)
    for c, rho in enumerate(correlations):
        rho = min(max(rho + (1.0 + 4.0 * rho + per_channel * (1.0 + rho)) / length, 0.0), 0.99)
        spread = gain[:, :, c] @ toeplitz(rho ** np.arange(length))
        # a fit absorbs part of slow noise, which lowers the variance of the residuals
        rest = length - float((spread * slopes[:, c].T).sum())
        size = power[c] / max(length - per_channel, 1.0) * length / max(rest, 0.5 * length)
        total += size * (spread * gain[:, :, c]).sum(axis=1)
    return np.maximum(total, variance), "correlated", quantile
