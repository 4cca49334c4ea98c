"""Measures the performance of searches: success rates, costs to a target, summaries and rank correlations.

Intervals are at 95%.

Sources: Wilson 1927 (success rates), Hansen et al. 2016, *COCO performance assessment* (average runtime),
Agarwal et al. 2021, *Deep RL at the edge of the statistical precipice* (interquartile mean,
probability of improvement), Dahl et al. 2023, *AlgoPerf* (the integral of the performance profile), Efron 1979
(bootstrap), Hesterberg 2015, *What teachers should know about the bootstrap* (its quantiles for few values). Ranks are
SciPy's. The Wilson interval and Spearman's rho agree with SciPy's to 1e-14. SciPy's are not used because their last
digits differ from stored results, SciPy rejects an interval without trials, and its rho is five times slower, which
matters in a bootstrap. SciPy's bootstrap has no strata and does not skip resamples without a value.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Z = 1.959963984540054
"""The 0.975 quantile of the standard normal distribution."""
RESAMPLES = 1000
"""Number of resamples per bootstrap interval."""

Interval = tuple[float, float]


def wilson(successes: int, trials: int) -> Interval:
    """Return Wilson's score interval of a success rate; ``(0, 1)`` without trials.

    >>> [round(x, 4) for x in wilson(8, 10)]
    [0.4902, 0.9433]
    """
    if trials == 0:
        return 0.0, 1.0
    share, weight = successes / trials, Z * Z / trials
    middle = (share + weight / 2) / (1 + weight)
    half = Z / (1 + weight) * math.sqrt(share * (1 - share) / trials + weight / (4 * trials))
    # rounding must not exclude a share of 0 or 1 itself
    low = 0.0 if successes == 0 else max(0.0, middle - half)
    return low, 1.0 if successes == trials else min(1.0, middle + half)


def _tail(sizes: Sequence[int]) -> float:
    """Return the probability of each tail of a percentile interval of a mean over strata of these sizes.

    The spread of resamples of n values is too small by sqrt((n - 1) / n), and it is itself uncertain, as in Student's
    interval. Wider quantiles correct both (Hesterberg 2015). A stratum of one value adds nothing to the spread.
    """
    from scipy.special import ndtr, stdtrit

    degrees = sum(sizes) - len(sizes)
    return float(ndtr(-math.sqrt(sum(sizes) / degrees) * stdtrit(degrees, 0.975))) if degrees else 0.0


def bootstrap(strata: Sequence[np.ndarray], statistic: Callable[[Sequence[np.ndarray]], Any]) -> tuple[Any, Any]:
    """Return the bootstrap percentile interval of a statistic, a number or an array, resampling each stratum along its first axis.

    Resamples in which the statistic is NaN are ignored. The interval is NaN if all are. :func:`_tail` gives the quantiles.
    """
    rng = np.random.default_rng(0)
    drawn = [statistic([part[rng.integers(0, len(part), len(part))] for part in strata]) for _ in range(RESAMPLES)]
    tail = _tail([len(part) for part in strata])
    with warnings.catch_warnings(action="ignore"):  # NaN in all resamples
        low, high = np.nanquantile(drawn, [tail, 1.0 - tail], axis=0, method="nearest")
    return low, high


def average_runtime(spent: np.ndarray, reached: np.ndarray) -> float:
    """Return the total cost of all searches, failed ones included, over the number of successes; inf without a success.

    ``spent (n,)`` is the cost until the target, or until the search stopped; ``reached (n,)`` is whether it succeeded.

    >>> average_runtime(np.array([10.0, 30.0, 20.0]), np.array([True, False, True]))
    30.0
    """
    count = int(np.count_nonzero(reached))
    return float(np.sum(spent) / count) if count else math.inf


def runtime_interval(spent: np.ndarray, reached: np.ndarray) -> Interval:
    """Return the bootstrap interval of :func:`average_runtime`.

    The upper end is infinite where too many resamples contain no success.
    """
    drawn = np.random.default_rng(0).integers(0, len(spent), (RESAMPLES, len(spent)))
    counts = reached[drawn].sum(axis=1)
    values = np.where(counts > 0, spent[drawn].sum(axis=1) / np.maximum(counts, 1), math.inf)
    tail = _tail([len(spent)])
    low, high = np.quantile(values, [tail, 1.0 - tail], method="nearest")
    return float(low), float(high)


def clustered_error(values: np.ndarray, clusters: np.ndarray) -> float:
    """Return half the 95% interval of the mean of ``values (n,)``, whose errors are shared within clusters; NaN for one cluster.

    Clusters are independent. Student's quantile has one degree of freedom less than there are clusters (Cameron and Miller
    2015, *A practitioner's guide to cluster-robust inference*).
    """
    from scipy.special import stdtrit

    known, place = np.unique(clusters, return_inverse=True)
    count = len(known)
    if count < 2:
        return math.nan
    sums = np.bincount(place, weights=values - np.mean(values))
    error = math.sqrt(count / (count - 1) * float(sums @ sums)) / len(values)
    return float(stdtrit(count - 1, 0.975)) * error


def interquartile_mean(values: np.ndarray) -> Any:
    """Return the mean of the middle half of the values along the first axis; NaN without values.

    A value at the edge of that half is weighted by its share in it.

    >>> float(interquartile_mean(np.array([0.0, 1.0, 2.0, 9.0])))
    1.5
    """
    n = len(values)
    if not n:
        return np.full(values.shape[1:], math.nan)[()]
    edges = np.arange(n + 1) / n
    inside = np.clip(np.minimum(edges[1:], 0.75) - np.maximum(edges[:-1], 0.25), 0.0, None)
    return np.sort(values, axis=0).T @ inside / inside.sum()
