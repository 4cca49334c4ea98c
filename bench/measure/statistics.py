"""Computes bias, variance and their intervals, as pure functions of arrays.

R independent estimates ``x_r`` of a gradient are compared with a :class:`Truth`. With m = mean(x) - truth and
S = cov(x) / R + cov(truth), the covariance of m, everything about the bias b = E m follows from

    E |m|^2 = |b|^2 + tr S,        Var |m|^2 = 2 tr S^2 + 4 b'Sb        (Gaussian m),

so |m| overstates the bias because m is noisy. The interval inverts this law, see :func:`bias_interval`.

Sources: Chen and Qin 2010 (|m|^2 - tr S in many dimensions), Himeno and Yamada 2014 (unbiased tr S^2 under any
noise), Satterthwaite 1946 (moment matching), Sankaran 1959 (normal form of the noncentral chi-square), Welch 1947
(degrees of freedom of a sum of variances), Efron and Stein 1981 (jackknife), Hall 1992 (skewness, On the removal of
skewness by transformation).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

REVISION = 1
"""Raised when a stored number that this module decides moves."""

ROUNDING = 1e-12
"""Differences below this share of a gradient's size are rounding: no bias, and no spread of the estimates."""
THREE = 3.0
"""Numerator of the rule of three: an event absent from n trials has a probability below 3 / n, at 95% confidence."""
PHYSICS = "physics: "
"""Start of a backend's remark on a row: a difference of its physics, which leaves intervals as they are."""
UNEXPLAINED = "tails unseen or gradient wrong"
"""Remark on a row whose estimator is declared unbiased although the interval of its bias excludes 0."""


def is_unexplained(reason: str) -> bool:
    """Return whether a row's remark marks its bias as not established: it contradicts the estimator's declaration."""
    return UNEXPLAINED in reason


# ------------------------------------------------------------------------------------------- error of a mean


@dataclass(frozen=True)
class Sampling:
    """The covariance of a mean, ``rows' rows``, stored as ``rows`` so that a large d needs no d x d matrix."""

    rows: np.ndarray
    """``(K, d)``. For a sample of K: deviations from the sample's mean, divided by sqrt(K (K - 1))."""
    degrees: float
    """Degrees of freedom: K - 1 for a sample of K, infinite for a known covariance."""
    equal: float = 0.0
    """A standard deviation of every coordinate beside the rows: that of an error without direction."""

    @classmethod
    def of(cls, sample: np.ndarray) -> Sampling:
        """Return the covariance of the mean of the independent rows of ``sample (K, d)``, with K > 1."""
        count = len(sample)
        return cls((sample - sample.mean(axis=0)) / math.sqrt(count * (count - 1)), count - 1)

    @classmethod
    def without_direction(cls, error: float, dim: int) -> Sampling:
        """Return the known covariance of an error of norm ``error`` whose direction is unknown."""
        return cls(np.zeros((0, dim)), math.inf, error / math.sqrt(dim))

    @property
    def trace(self) -> float:
        """Trace of the covariance: the expected squared distance of the mean from its expectation."""
        return float(np.vdot(self.rows, self.rows) + self.equal**2 * self.rows.shape[1])

    def over(self, unit: float) -> Sampling:
        """Return the same covariance, measured in ``unit``."""
        return replace(self, rows=self.rows / unit, equal=self.equal / unit)

    def excess(self) -> float:
        """Return the upward bias of tr C^2 as an estimate, where C is the covariance of a sample's mean; 0 for a known C.

        For n + 1 = K rows r with C = sum r r', the unbiased estimate under any noise is (Himeno and Yamada 2014)
        ``n / (K (K-2) (K-3)) * (n (K-2) tr C^2 + (tr C)^2 - K n sum |r|^4)``. With fewer than four rows no unbiased
        estimate exists, and the upper bound (tr C)^2 replaces it.
        """
        if math.isinf(self.degrees):
            return 0.0
        n, count = self.degrees, self.degrees + 1.0
        squares = np.einsum("kd,kd->k", self.rows, self.rows)
        trace, raw = float(squares.sum()), _trace_square(self.rows)
        if count < 4:
            return raw - trace**2
        spread = n * (count - 2) * raw + trace**2 - count * n * float(squares @ squares)
        unbiased = n / (count * (count - 2) * (count - 3)) * spread
        return float(raw - min(max(unbiased, trace**2 / self.rows.shape[1]), trace**2))


def _length(values: np.ndarray) -> float:
    """Return the norm of all numbers in an array, without overflow or underflow of their squares."""
    largest = float(np.abs(values).max(initial=0.0))
    if largest == 0.0 or 1e-100 < largest < 1e100:
        return float(np.linalg.norm(values))
    return float(np.linalg.norm(values / largest)) * largest


def _trace_square(rows: np.ndarray) -> float:
    """Return the trace of (rows' rows)^2 for ``rows (K, d)``, from whichever of the two Gram matrices is smaller."""
    gram = rows @ rows.T if rows.shape[0] <= rows.shape[1] else rows.T @ rows
    return float(np.vdot(gram, gram))


@dataclass(frozen=True)
class Truth:
    """The reference gradient, and the sampling error of its mean."""

    mean: np.ndarray
    """``(d,)``."""
    sampling: Sampling
    """Sampling error of ``mean``, independent of the errors of the estimates."""
    unseen: float = 0.0
    """Norm of an error of unknown direction that ``sampling`` does not show."""

    def __post_init__(self) -> None:
        finite = np.isfinite(self.mean).all() and np.isfinite(self.sampling.rows).all()
        if not (finite and math.isfinite(self.unseen)):
            raise ValueError("the reference gradient or its error is not finite, so nothing can be compared with it")

    @classmethod
    def exact(cls, mean: np.ndarray, error: float = 0.0) -> Truth:
        """Return a truth from a closed form or quadrature ``(d,)``; its error has norm ``error`` and unknown direction."""
        mean = np.asarray(mean, dtype=np.float64)
        return cls(mean, Sampling.without_direction(error, mean.size))

    @classmethod
    def from_batches(cls, batches: np.ndarray, unseen: float = 0.0) -> Truth:
        """Return a truth from K > 1 independent means ``(K, d)`` of equally large batches, whose spread is its error.

        ``unseen`` is the norm of an error that this spread does not show.
        """
        return cls(batches.mean(axis=0), Sampling.of(batches), unseen)

    @property
    def norm(self) -> float:
        """Length of the gradient."""
        return _length(self.mean)

    @property
    def errors(self) -> tuple[Sampling, ...]:
        """The independent errors: the sampling error and, if any, the error that sampling does not show."""
        hidden = (Sampling.without_direction(self.unseen, self.mean.size),) if self.unseen else ()
        return (self.sampling, *hidden)

    @property
    def standard_error(self) -> float:
        """Square root of the trace of the covariance of the mean, including the error that sampling does not show."""
        hidden = self.sampling.equal * math.sqrt(self.mean.size)
        return math.hypot(_length(self.sampling.rows), hidden, self.unseen)

    def vanishes(self) -> bool:
        """Return whether the gradient is not distinguishable from 0, so that relative quantities are undefined."""
        return self.norm == 0.0 or (self.standard_error > 0.0 and bias_interval(self.mean, *self.errors)[1] == 0.0)

    def over(self, unit: float) -> Truth:
        """Return the same truth, measured in ``unit``."""
        return Truth(self.mean / unit, self.sampling.over(unit), self.unseen / unit)


# ---------------------------------------------------------------------------------------------------- intervals


def bias_interval(difference: np.ndarray, *errors: Sampling, level: float = 0.95) -> tuple[float, float, float]:
    """Return the de-biased norm of a difference of means, and the low and high end of the interval of the true norm.

    ``difference m (d,)`` has the covariance S, the sum of the covariances of the independent ``errors``. With T =
    |m|^2, the norm is sqrt(max(0, T - tr S)). For a supposed norm beta, T is modelled as g times a noncentral
    chi-square with nu degrees of freedom and noncentrality beta^2 / g, where

        g = (tr S^2 + 2 q) / (tr S + 2 beta^2),    nu = tr S / g,    q = b'Sb

    give T the mean and variance stated at the top of this module. The term q matters because a bias in a direction of
    little noise is known more accurately than a bias in a direction of much noise. The unbiased estimate of q at the
    observed norm is q0 = m'Sm - tr S^2. At other norms, q follows the direction in which noise moves m,

        q(beta) = q0 + (m'S^2 m / m'Sm) (beta^2 - T + tr S),    limited to 0 ... tr S beta^2.

    The interval contains the beta at which T lies within Student's quantiles, with the degrees of freedom of S, on the
    normal scale of Sankaran's transform. Where T is below tr S, the upper end is computed for T = tr S, so that a lucky
    draw never claims more than the noise allows. The lower end is 0 where T is within its quantiles for a bias of 0. An
    interval can miss a bias of 0 only from above, so it covers a bias of 0 97.5% of the time.

    ``validation/intervals.py`` measures the coverage.
    """
    observed, trace = float(difference @ difference), sum(error.trace for error in errors)
    if trace <= 1e-32 * observed or trace == 0.0:  # noise below the last digit of m
        return (math.sqrt(observed),) * 3

    # from here on all numbers are in units of tr S
    unit = math.sqrt(trace)
    errors = tuple(error.over(unit) for error in errors)
    difference = difference / unit
    rows = np.concatenate([error.rows for error in errors])
    doubt = sum(error.trace**2 / error.degrees for error in errors)  # Welch: the reciprocal of the degrees of freedom
    # S = rows' rows + equal I
    equal, dim = sum(error.equal**2 for error in errors), difference.size
    square = _trace_square(rows) + equal * (2.0 * float(np.vdot(rows, rows)) + equal * dim)
    square = square - sum(error.excess() for error in errors)
    square = min(max(square, 1.0 / difference.size), 1.0)
    total = float(difference @ difference)
    image = rows @ difference
    once = float(image @ image) + equal * total  # m'Sm
    image = image @ rows + equal * difference
    twice = (float(image @ image) - once * doubt) / (1.0 + doubt)  # m'S^2 m, less the noise in S
    directional = min(once / total, 1.0) if total else square
    slope = min(max(twice / once if once else 0.0, directional), 1.0)

    def score(total_: float, beta: float) -> float:
        power = beta * beta
        along = min(max(once - square + slope * (power - total + 1.0), 0.0), power)
        scale = (square + 2.0 * along) / (1.0 + 2.0 * power)
        return _noncentral_score(total_ / scale, 1.0 / scale, power / scale)

    limit = _student_quantile(0.5 + level / 2.0, 1.0 / doubt if doubt else math.inf)
    end = math.sqrt(total)
    low = 0.0 if score(total, 0.0) <= limit else _bisect(limit, lambda beta: score(total, beta), end)
    seen, end = max(total, 1.0), max(end, 1.0) + limit
    while score(seen, end) > -limit:
        end *= 2.0
    high = _bisect(-limit, lambda beta: score(seen, beta), end)
    return math.sqrt(max(0.0, total - 1.0)) * unit, low * unit, high * unit


def _noncentral_score(value: float, nu: float, noncentrality: float) -> float:
    """Return the standard normal score of a noncentral chi-square value (Sankaran 1959, the second of his forms)."""
    first, second, third = nu + noncentrality, nu + 2.0 * noncentrality, nu + 3.0 * noncentrality
    h = 1.0 - 2.0 / 3.0 * first * third / second**2
    p = second / first**2
    m = (h - 1.0) * (1.0 - 3.0 * h)
    centre = 1.0 + h * p * (h - 1.0 - 0.5 * (2.0 - h) * m * p)
    return float(((value / first) ** h - centre) / (h * math.sqrt(2.0 * p) * (1.0 + 0.5 * m * p)))


def _bisect(target: float, function: Callable[[float], float], high: float) -> float:
    """Return where in ``[0, high]`` a decreasing function reaches ``target``, by 50 bisections.

    ``scipy.optimize.bisect`` needs a sign change at the ends, which rounding may remove, and returns other last digits.
    """
    low = 0.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        if function(middle) > target:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _student_quantile(probability: float, degrees: float) -> float:
    from scipy.special import ndtri, stdtrit

    return float(ndtri(probability) if math.isinf(degrees) else stdtrit(degrees, probability))


def variance_interval(deviations: np.ndarray) -> tuple[float, float]:
    """Return the interval of the trace of the covariance, from the deviations from the mean ``(R, d)``.

    The interval is the jackknife of the logarithm, which accounts for kurtosis, with the upper end of
    :func:`_jackknife`, which accounts for skewness. Omitting repeat i removes ``R / (R - 1) |x_i - mean|^2`` from the
    sum of squares. The interval is ``(0, inf)`` where fewer than three repeats differ, and a single point where all
    repeats are equal.
    """
    repeats = len(deviations)
    squares = np.einsum("rd,rd->r", deviations, deviations)
    total = float(squares.sum())
    if total == 0.0 and repeats > 1:
        return 0.0, 0.0
    left = total - squares * repeats / max(repeats - 1, 1)
    if repeats < 3 or left.min() <= 1e-12 * total:  # rounding: the other repeats are all the same
        return 0.0, math.inf
    return _jackknife(math.log(total / (repeats - 1)), np.log(left) - math.log(repeats - 2))


def _jackknife(whole: float, without: np.ndarray) -> tuple[float, float]:
    """Return the interval of a variance from its logarithm and the logarithms ``(R,)`` with one repeat omitted.

    The pseudo-values are as skewed as the squares they come from. Where large squares are rare, most samples contain
    too few large squares, and a symmetric interval is too low. With the skewness g of the pseudo-values, Hall (1992)
    treats

        T + g T^2 / 3 + g^2 T^3 / 27 + g / (6 R),    T = (centre - truth) / spread,

    as normal with standard deviation 1 / sqrt(R). The upper end is the larger of Hall's and Student's. The lower end is
    Student's, which missing squares do not lower.
    """
    repeats = len(without)
    pseudo = repeats * whole - (repeats - 1) * without
    centre, spread = float(pseudo.mean()), float(pseudo.std(ddof=1))
    reach = _student_quantile(0.975, repeats - 1) / math.sqrt(repeats)
    up = reach
    if spread > 0.0:
        skewness = repeats / (repeats - 2) * float((((pseudo - centre) / spread) ** 3).sum()) / (repeats - 1)
        # skewness below which its correction is rounding
        if skewness > 1e-6:
            cube = 1.0 - skewness * (reach + skewness / (6.0 * repeats))
            up = max(reach, 3.0 / skewness * (1.0 - math.cbrt(cube)))
    return _exp(min(centre - reach * spread, whole)), _exp(max(centre + up * spread, whole))


def variance_per_sample(sums: np.ndarray, squares: np.ndarray, samples: int) -> tuple[float, float, float]:
    """Return the trace of the covariance of one sample's term, with its interval, from all R x N terms.

    ``sums (R, d)`` are the sums of the ``samples`` terms of each repeat, ``squares (R,)`` the sums of their squared
    norms. Where the mean of the terms is large compared with their spread, subtract a common vector from all terms
    first. The interval is the jackknife over repeats of :func:`variance_interval`, which accounts for tails. It is
    ``(0, inf)`` for fewer than three repeats, and NaN where there is only one term in total.
    """
    repeats = len(sums)
    count = repeats * samples
    if count < 2:
        return (math.nan,) * 3
    total, power = sums.sum(axis=0), float(squares.sum())
    if math.isinf(power):  # of finite terms whose squares overflow
        return math.inf, 0.0, math.inf
    # a difference below this share of the squares is rounding
    floor = 1e-14 * power
    whole = power - float(total @ total) / count
    value = max(0.0, whole) / (count - 1)
    rest = total - sums
    left = power - squares - np.einsum("rd,rd->r", rest, rest) / max(count - samples, 1)
    if repeats < 3 or whole <= floor or left.min() <= floor:
        return value, 0.0, math.inf
    return value, *_jackknife(math.log(value), np.log(left) - math.log(count - samples - 1))


def _exp(exponent: float) -> float:
    return math.exp(exponent) if exponent < 709.0 else math.inf


# ------------------------------------------------------------------------------------------------------ summary


def rmse(bias: Any, variance: Any) -> Any:
    """Return the root mean squared error of one estimate, at least its standard deviation; NaN if either is not known.

    Bias and variance are de-biased, so their sum is the mean squared distance to the reference less the reference's own
    error, except that a bias below its noise counts as 0 instead of reducing the variance.
    """
    return np.hypot(bias, np.sqrt(variance))


@dataclass(frozen=True)
class Summary:
    """Statistics of R estimates of N samples each, compared with the reference. Norms are Euclidean, intervals 95%.

    A field that cannot be computed is NaN: every field of the estimates when some are not finite, every field of their
    spread when there is only one estimate, relative fields for a reference not distinguishable from 0, and directional
    fields for a reference of 0.
    """

    grad_norm: float
    """Norm of the mean estimate."""
    reference_norm: float
    reference_se: float
    """Standard error of the reference, as the root of the trace of its covariance."""
    bias: float
    """sqrt(max(0, |m|^2 - tr S)), where m is the mean estimate minus the reference and S the covariance of m."""
    bias_low: float
    bias_high: float
    bias_rel: float
    """``bias / reference_norm``."""
    variance: float
    """Trace of the covariance of one estimate."""
    variance_low: float
    variance_high: float
    variance_per_sample: float
    """``samples * variance``, or computed from the terms of all samples where their sums are given."""
    variance_per_sample_low: float
    variance_per_sample_high: float
    rmse: float
    """:func:`rmse` of ``bias`` and ``variance``."""
    rmse_rel: float
    """``rmse / reference_norm``."""
    cosine: float
    """Mean over repeats of the cosine between one estimate and the reference; an estimate of 0 counts as 0."""
    sign_agreement: float
    """Share of one estimate's coordinates that have the reference's sign, among those where the reference is not 0."""
    finite_fraction: float
    """Share of repeats whose coordinates are all finite."""
    note: str = ""
    """Caveats for reading the intervals; empty if there are none."""


def summarise(
    estimates: np.ndarray,
    truth: Truth,
    samples: int,
    terms: tuple[np.ndarray, np.ndarray] | None = None,
    unbiased: bool = False,
    is_random: bool = True,
) -> Summary:
    """Return the statistics of independent ``estimates (R, d)`` of ``samples`` samples each, compared with the reference.

    ``terms`` are the sums and squares for :func:`variance_per_sample`, for estimates that are means of one term per
    sample. Without ``terms``, the variance per sample is ``samples`` times the variance of an estimate. ``unbiased`` is
    the estimator's declaration: a bias of an estimator declared unbiased gets the remark :data:`UNEXPLAINED`. The
    relative fields are NaN, with a remark, where the reference is not distinguishable from 0. Intervals of identical
    estimates allow for an event of the gradient's size that no estimate contains, with the probability that the rule of
    three leaves for such an event; with ``is_random=False``, for estimates that depend on no drawn number, they do not.
    Raises ValueError for shapes that do not fit. Estimates that are not finite do not raise: see :class:`Summary`.
    """
    estimates = np.asarray(estimates, dtype=np.float64)
    _check_shapes(estimates, truth, samples)
    repeats = len(estimates)
    finite = np.isfinite(estimates).all(axis=1).sum()
    if finite < repeats:
        return _not_finite(truth, finite / repeats, f"{repeats - finite} of {repeats} estimates are not finite")

    # numbers are in units of the largest entry, so that squares of very large or small gradients do not overflow or underflow
    unit = max(float(np.abs(part).max(initial=0.0)) for part in (estimates, truth.mean, truth.sampling.rows)) or 1.0
    estimates, reference = estimates / unit, truth.over(unit)
    identical = (np.abs(estimates - estimates[0]) <= ROUNDING * np.abs(estimates[0])).all()
    mean = estimates[0] if identical else estimates.mean(axis=0)
    deviations = np.zeros_like(estimates) if identical else estimates - mean
    is_fixed = identical and repeats > 1 and not is_random
    missed = THREE / (repeats * samples) if identical and not is_fixed else 0.0
    bias, variance = _spread(deviations, mean, reference, samples, missed)
    error = float(rmse(bias[0], variance[0]))
    norm = reference.norm
    # a sampled reference states its own error, rounding included
    relative = math.nan if norm <= ROUNDING * math.isinf(reference.sampling.degrees) or reference.vanishes() else norm
    cosine, signs = _directions(estimates, reference.mean)
    notes = [] if is_fixed else _interval_remarks(deviations, mean - reference.mean, missed)
    notes += _reference_remarks(reference, relative)
    if unbiased and bias[1] > 0.0:
        notes.append(f"declared unbiased, and its interval excludes 0: {UNEXPLAINED}, or chance (about 1 row in 30)")
    per_sample = tuple(value * samples * unit * unit for value in variance)
    if terms is not None:
        _, low, high = per_sample = variance_per_sample(*terms, samples)
        # only if the mean of the terms were exact could the interval be so narrow
        if low > 0.0 and math.log(high / low) < 10.0 / (repeats * samples):
            notes.append("all terms are equally far from their mean: the interval of their variance is too narrow")
    return Summary(
        grad_norm=float(np.linalg.norm(mean)) * unit,
        reference_norm=norm * unit,
        reference_se=reference.standard_error * unit,
        **ends("bias", [value * unit for value in bias]),
        bias_rel=bias[0] / relative,
        **ends("variance", [value * unit * unit for value in variance]),
        **ends("variance_per_sample", per_sample),
        rmse=error * unit,
        rmse_rel=error / relative,
        cosine=cosine,
        sign_agreement=signs,
        finite_fraction=1.0,
        note="; ".join(notes),
    )


def _check_shapes(estimates: np.ndarray, truth: Truth, samples: int) -> None:
    """Raise ValueError for estimates that are not those of the truth's gradient, or of no sample."""
    if estimates.ndim != 2 or len(estimates) < 1 or estimates.shape[1:] != truth.mean.shape:
        raise ValueError(
            f"estimates have the shape (R, {truth.mean.size}) with R > 0, as the reference has "
            f"{truth.mean.size} coordinates; given {estimates.shape}"
        )
    if samples < 1:
        raise ValueError(f"an estimate is made of one sample or more; given {samples}")


def ends(name: str, values: Iterable[Any]) -> dict[str, Any]:
    """Return a number, or a list, and the ends of its interval by name, ``<name>_low`` and ``<name>_high``."""
    return dict(zip((name, f"{name}_low", f"{name}_high"), values, strict=True))


def _spread(
    deviations: np.ndarray, mean: np.ndarray, reference: Truth, samples: int, missed: float
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return bias and variance, each with its interval, of estimates with ``deviations (R, d)`` from their mean; NaN for R = 1.

    The intervals allow for an event of the gradient's size with the probability ``missed`` per sample.
    """
    repeats = len(deviations)
    if repeats == 1:
        return (math.nan,) * 3, (math.nan,) * 3
    variance = float(np.vdot(deviations, deviations)) / (repeats - 1)
    variance_low, variance_high = variance_interval(deviations)
    sampling = Sampling(deviations / math.sqrt(repeats * (repeats - 1)), repeats - 1)
    bias, low, high = bias_interval(mean - reference.mean, sampling, *reference.errors)
    norm, grad_norm = reference.norm, float(np.linalg.norm(mean))
    if missed:
        size = max(norm, grad_norm)
        low, high = low - missed * size, high + missed * size
        variance_high = missed * size**2 / samples
    return (bias, 0.0 if low <= ROUNDING * (norm + grad_norm) else low, high), (variance, variance_low, variance_high)


def summarise_without_reference(estimates: np.ndarray, samples: int, reason: str) -> Summary:
    """Return the statistics of :func:`summarise` that need no reference, for ``estimates (R, d)``; ``reason`` is a note.

    All fields that compare the estimates with a reference are NaN.
    """
    dim = np.asarray(estimates).shape[-1]
    summary = summarise(estimates, Truth.exact(np.zeros(dim)), samples)
    compared = ("reference_", "bias", "rmse", "cosine", "sign")
    fields = {name: math.nan for name in Summary.__dataclass_fields__ if name.startswith(compared)}
    return replace(summary, note="; ".join(part for part in (summary.note, reason) if part), **fields)


def _not_finite(truth: Truth, finite_fraction: float, note: str) -> Summary:
    values = dict.fromkeys((name for name in Summary.__dataclass_fields__ if name != "note"), math.nan)
    known = dict(reference_norm=truth.norm, reference_se=truth.standard_error, finite_fraction=finite_fraction)
    return Summary(**{**values, **known}, note=note)


def _directions(estimates: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Return the mean cosine between estimates ``(R, d)`` and reference ``(d,)``, and the share of equal signs."""
    nonzero = reference != 0.0
    if not nonzero.any():
        return math.nan, math.nan
    lengths = np.linalg.norm(estimates, axis=1)
    unit = reference / np.abs(reference).max()
    projections = estimates @ (unit / np.linalg.norm(unit)) / np.where(lengths > 0.0, lengths, 1.0)
    agree = np.sign(estimates[:, nonzero]) == np.sign(reference[nonzero])
    return float(np.clip(projections, -1.0, 1.0).mean()), float(agree.mean())


def _reference_remarks(reference: Truth, relative: float) -> list[str]:
    """Return remarks on how the reference limits relative columns; ``relative`` is its norm, NaN where it vanishes."""
    norm, error = reference.norm, reference.standard_error
    if math.isnan(relative):
        if error == 0.0:
            return []  # exactly 0, as many references are
        share = f"{error / norm:.2g} times its norm" if norm else f"{error:.2g} and its norm is 0"
        return [
            f"the reference is not distinguishable from 0, its error is {share}: relative columns, cosine and signs are meaningless"
        ]
    # error of a reference, as a share of its norm, above which a note warns that relative columns are no more
    # accurate
    if error > 0.1 * norm:
        return [
            f"the reference is known to {100 * error / norm:.0f}% of its norm: relative columns are no more accurate"
        ]
    return []


def heavy_tails(deviations: np.ndarray) -> float:
    """Return the largest share of one repeat in the squares of ``deviations (R, d)``, or 0 if tails are not heavy."""
    squares = np.einsum("rd,rd->r", deviations, deviations)
    total, fourth = float(squares.sum()), float(squares @ squares)
    # tails are heavy when (sum y)^2 / sum y^2 of the squared deviations y is below this times sqrt(R). That holds for
    # 5% of cells with normal noise at R = 8, 1% at 16, none of thousands at 64, and half of cells with kurtosis 100
    if fourth > 0.0 and total**2 / fourth < 0.75 * math.sqrt(len(deviations)):
        return float(squares.max()) / total
    return 0.0


def _interval_remarks(deviations: np.ndarray, difference: np.ndarray, missed: float) -> list[str]:
    """Return remarks that question the intervals, from deviations ``(R, d)`` and a difference of means ``(d,)``."""
    repeats = len(deviations)
    if repeats == 1:
        return ["only 1 repeat: no variance, and no interval of the bias"]
    if missed:
        return [
            "all estimates are identical: the intervals allow for an event of the gradient's size, rarer than about "
            f"{missed:.2g} per sample, which these samples would miss"
        ]
    # a test of tails needs 8 repeats
    if repeats < 8:
        return [f"only {repeats} repeats: intervals are wide, and tails are not tested"]
    for part, where in ((deviations, ""), ((deviations @ difference)[:, None], " along the bias")):
        if share := heavy_tails(part):
            return [
                f"heavy tails: one repeat of {repeats} has {100 * share:.0f}% of the squared "
                f"deviations{where}, a fourth moment that makes the intervals unreliable"
            ]
    return []
