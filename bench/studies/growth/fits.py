"""Decides whether norms along the horizon follow a polynomial or an exponential, or neither beyond doubt."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

STRONG = 20.0
"""Ratio of likelihoods from which one curve beats the other. By it, at most 5% of noisy power laws count as exploding."""
ROUNDING = 1e-6
"""Smallest error of a norm's logarithm: norms that a curve describes exactly differ from it by rounding."""
FEWEST = 5
"""Fewest horizons of a verdict: with four, 8% of noisy power laws count as exploding."""


@dataclass(frozen=True)
class Slope:
    """The slope of a line through logarithms of norms: the order of a power law, or the rate of an exponential."""

    value: float
    low: float
    high: float
    """The 95% interval (Student's t)."""
    residual: float
    """Sum of squared residuals of the logarithms, and of the norms' own errors."""


@dataclass(frozen=True)
class Fit:
    """How norms grow along the horizon."""

    verdict: str
    """exploding, polynomial, vanishing or open."""
    power: Slope
    exponential: Slope
    odds: float
    """Likelihood of the exponential relative to the power law: above 1 the exponential is nearer to the norms."""


def fit(horizons: np.ndarray, norms: np.ndarray, errors: np.ndarray, bounded: bool = False) -> Fit:
    """Fit a power law and an exponential to norms ``(n,)`` and decide which one they follow.

    ``errors`` are the standard errors of the norms' logarithms. ``bounded`` states that the Jacobian product does not
    grow, which leaves the power law if the norms do not contradict it. The ratio of likelihoods of two least-squares fits
    with equally many parameters is (residual_1 / residual_2)^(n/2).
    """
    errors = np.maximum(errors, ROUNDING)
    power, exponential = (_slope(places, np.log(norms), errors) for places in (np.log(horizons), horizons))
    odds = (power.residual / exponential.residual) ** (len(norms) / 2) if len(norms) >= FEWEST else math.nan
    verdict = "open"
    if odds >= STRONG and exponential.low > 0:
        verdict = "exploding"
    elif (odds >= STRONG and exponential.high < 0) or (odds <= 1 / STRONG and power.high < 0):
        verdict = "vanishing"
    elif power.low > 0 and (odds <= 1 / STRONG or (odds <= 1 and bounded)):
        verdict = "polynomial"
    return Fit(verdict, power, exponential, odds)


def _slope(places: np.ndarray, logarithms: np.ndarray, errors: np.ndarray) -> Slope:
    from scipy.special import stdtrit

    count = len(places)
    if count < 3 or np.ptp(places) == 0:
        return Slope(*[math.nan] * 4)
    away = places - places.mean()
    slope = float(away @ logarithms / (away @ away))
    start = float(logarithms.mean() - slope * places.mean())
    left = logarithms - start - slope * places
    residual = float(left @ left + errors @ errors)
    reach = float(stdtrit(count - 2, 0.975)) * math.sqrt(residual / (count - 2) / float(away @ away))
    return Slope(slope, slope - reach, slope + reach, residual)
