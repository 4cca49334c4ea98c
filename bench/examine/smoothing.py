"""Measures the effect of noise of size sigma on theta: the bias of the program's gradient, and the cost of each method.

The reference is grad J, J(theta) = E cost(theta + sigma u) with u ~ N(0, I). It is computed only from costs, so it is
right across jumps, which a mean of gradients misses. Costs are computed in pairs at +u and -u, with the same noise w of
the simulator: d = (cost(theta + sigma u) - cost(theta - sigma u)) / 2 sigma. Then E[d u] = grad J (Nesterov and
Spokoiny 2017, Found. Comput. Math. 17, section 2). Subtracting a fitted straight line d = b . u, whose mean is known,
removes most of the variance. Each half of the pairs uses the line fitted to the other half, so the mean stays unbiased.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from bench.examine.lines import REACH, LineScan
from bench.simulator.clock import KINDS, OutOfTime
from bench.simulator.simulator import Simulator

PAIRS = 4096
"""Most pairs of costs for one sigma."""
OWN_PAIRS = 65536
"""Most pairs where only the cost has noise, whose gradient may be an estimator."""
FEWEST = 64
"""Fewest pairs for a result."""
FIRM = 1024
"""Fewest pairs before sampling stops early, however small the spread, since a jump may be rare."""
GROUPS = 32
"""Number of independent means from which intervals are computed."""
ENOUGH = 0.03
"""Relative standard error of grad J at which sampling stops, once the bias is decided."""
CLEAR = 4.0
"""Multiple of its standard error above which grad J is distinguishable from 0."""
SMALL_BIAS = 0.01
"""Width of the bias interval, relative to |grad J|, below which remarks on it are omitted."""
RARE = 30.0
"""Expected number of draws beyond a jump below which they do not measure it."""
UNMET = 3.0
"""Expected number of draws that an event meets in none of them in 5% of cases."""
TARGET_ERROR = 0.1
"""Relative error at which the costs of the methods are compared."""


@dataclass(frozen=True)
class Method:
    """A method of estimating grad J, and its cost for a relative error of 10%."""

    name: str
    """``plain``: the program's gradient without noise; ``gradient``: mean of its gradients under noise; ``mirrored``: the same at
    +u and -u; ``smoothing``: pairs of costs along random directions."""
    bias: float
    """Upper end of the 95% interval of the method's bias, relative to |grad J|."""
    samples: float
    """Samples for a relative root-mean-square error of 10%; infinite where the bias is 10% or more, NaN where it may be."""
    calls: float
    """Calls of cost or gradient for these samples."""
    seconds: float


@dataclass(frozen=True)
class Smoothed:
    """The bias of the program's gradient and the cost of each method, at one sigma."""

    sigma: float
    gradient: np.ndarray
    """grad J ``(d,)``, computed from costs."""
    error: float
    """Standard error of grad J, as a norm. Norms weigh each input by its sigma, relative to the largest."""
    norm: float
    """|grad J|, with the contribution of noise subtracted."""
    pairs: int
    bias: float = math.nan
    """|E program's gradient - grad J|, with the contribution of noise subtracted; NaN without a gradient."""
    bias_low: float = math.nan
    bias_high: float = math.nan
    """The 95% interval of the bias."""
    moved: float = math.nan
    """|grad J - grad cost| at theta, the effect of smoothing; NaN without a right gradient."""
    remark: str = ""
    """Why the intervals may be too narrow; empty if there is no such reason."""
    methods: tuple[Method, ...] = ()
    n_moved: int = 0
    """Number of pairs whose costs differ."""
    n_lost: int = 0
    """Number of pairs with a gradient that is not a number, where the costs are numbers."""
    unseen: float = 0.0
    """Part of grad J that an event which no draw meets may have: no bound on the bias is below it."""

    @property
    def bias_percent(self) -> tuple[float, float]:
        """The ends of the bias interval in percent of |grad J|, which is not 0."""
        return 100 * self.bias_low / self.norm, 100 * self.bias_high / self.norm

    @property
    def known(self) -> bool:
        """Whether grad J is clearly larger than its own error."""
        return self.norm > CLEAR * self.error

    @property
    def decided(self) -> bool:
        """Whether the bias interval is entirely above or entirely below 10% of |grad J|."""
        edge = TARGET_ERROR * self.norm
        return not self.bias_low <= edge <= self.bias_high

    @property
    def is_usable(self) -> bool:
        """Whether the bias is known to be below 10% of |grad J|."""
        return self.known and self.decided and not self.cause and math.isfinite(self.bias)

    @property
    def cause(self) -> str:
        """The problem with the mean of the program's gradients: ``nonfinite``, ``nan_gradient``, ``biased``, ``spread``, or empty.

        It is ``biased`` where the bias interval is entirely above 10% of |grad J|, or of its upper limit where grad J is not
        distinguishable from 0. It is ``spread`` where the interval contains 10%, or where grad J is not distinguishable
        from 0 though its error is not 0.
        """
        edge = TARGET_ERROR * self.norm
        if not math.isfinite(self.norm):
            return "nonfinite"
        if self.n_lost:
            return "nan_gradient"
        if self.bias_low > (edge if self.known else TARGET_ERROR * (self.norm + 2.0 * self.error)):
            return "biased"
        return "spread" if (self.bias_high > edge if self.known else self.error > 0.0) else ""

    @property
    def best(self) -> Method | None:
        """The fastest method to reach an error of 10%; None if no method reaches it, or the samples of gradients are not known."""
        usable = [m for m in self.methods if m.seconds < math.inf]
        is_open = any(math.isnan(m.seconds) for m in self.methods if m.name != "plain")
        return min(usable, key=lambda m: m.seconds) if usable and self.known and not is_open else None


def measure_smoothed(
    simulator: Simulator,
    sigma: float,
    spread: np.ndarray,
    plain: np.ndarray | None,
    seed: int = 0,
    pairs: int = PAIRS,
    unseen: Callable[[int], tuple[float, float]] | None = None,
) -> Smoothed:
    """Return the gradient's bias and the methods' costs under noise ``spread * u`` on theta, called ``sigma``.

    Raises :class:`OutOfTime` where the time is too short for :data:`FEWEST` pairs. ``plain (d,)`` is the gradient at theta without noise, if
    it is known to be right. At most ``pairs`` pairs are drawn. ``unseen`` is the part of ``sigma * grad J`` that a number of
    draws may miss.
    """
    random = np.random.default_rng([seed, 0x736D6F6F])
    drawn: list[np.ndarray] = []
    size, result = FEWEST, None
    try:
        while size <= pairs:
            drawn.append(_draw(simulator, spread, random, size if result is None else size // 2))
            result = _summary(sigma, spread, np.concatenate(drawn, axis=1), plain, simulator, unseen)
            if size >= FIRM and result.error <= ENOUGH * result.norm and result.decided:
                break
            size *= 2
    except OutOfTime:
        if result is None:
            raise
    assert result is not None
    return result


def _draw(simulator: Simulator, spread: np.ndarray, random: np.random.Generator, size: int) -> np.ndarray:
    """Return ``size`` pairs, ``(3 d + 1, size)``: directions u, half differences of costs, gradients at +u and at -u."""
    theta = simulator.layout.vector
    u = random.standard_normal((theta.size, size))
    w = random.standard_normal((simulator.noise, size)) if simulator.noise else None
    up, down = theta[:, None] + spread[:, None] * u, theta[:, None] - spread[:, None] * u
    d = (simulator.costs(up, w) - simulator.costs(down, w)) / 2.0
    if not simulator.has_gradient:
        return np.concatenate([u, d[None], np.full((2 * theta.size, size), np.nan)])
    return np.concatenate([u, d[None], simulator.gradients(up, w), simulator.gradients(down, w)])


def _summary(
    sigma: float,
    spread: np.ndarray,
    drawn: np.ndarray,
    plain: np.ndarray | None,
    simulator: Simulator,
    unseen: Callable[[int], tuple[float, float]] | None,
) -> Smoothed:
    # SciPy's distributions are slow to import, and only this function needs them
    from bench.measure.statistics import Truth, summarise

    size, pairs = spread.size, drawn.shape[1]
    # an input without noise has no smoothed derivative
    noisy = spread > 0
    spread = spread[noisy]
    largest = spread.max()
    d = drawn[size]
    u, up, down = (drawn[first : first + size][noisy] for first in (0, size + 1, 2 * size + 1))
    if not np.isfinite(d).all():
        share = f"{int((~np.isfinite(d)).sum())} of {pairs} pairs have a cost that is not a number"
        return Smoothed(sigma, np.full(spread.size, np.nan), math.inf, math.nan, pairs, remark=share)
    # in units of the largest sigma: an input's share of the bias is by how much it moves the cost under its own noise
    weight = (spread / largest)[:, None]
    up, down = weight * up, weight * down
    terms = d * u / largest
    groups = _means(_terms(u, d) / largest)
    truth = groups.mean(axis=0)
    error = float(np.sqrt(groups.var(axis=0, ddof=1).sum() / GROUPS))
    norm = math.sqrt(max(float(truth @ truth) - error**2, 0.0))
    bias = low = high = moved = math.nan
    jumps = event = 0.0
    remark = ""
    slopes = (up + down) / 2.0
    is_finite = np.isfinite(slopes).all(axis=0)
    n_lost = int((~is_finite).sum()) if simulator.has_gradient else 0
    if is_finite.all():
        judged = summarise(_means(slopes) - groups, Truth.exact(np.zeros(spread.size)), pairs // GROUPS)
        jumps, event = (np.array(unseen(2 * pairs) if unseen else (0.0, 0.0)) / largest).tolist()
        bias, low, high = judged.bias, judged.bias_low, max(judged.bias_high, jumps)
        # heavy tails make an interval unreliable, which does not matter for a narrow one
        remark = judged.note if high - low > SMALL_BIAS * norm else ""
    elif n_lost:
        remark = f"{n_lost} of {pairs} pairs have a gradient that is not a number"
    if plain is not None:
        moved = float(np.linalg.norm(truth - weight[:, 0] * plain[noisy]))
    methods: list[Method] = []
    if norm > CLEAR * error:
        each, slope = map(simulator.clock.seconds_per, KINDS)
        methods.append(_method("smoothing", (0.0, 0.0), terms, norm, 2, each))
        if plain is not None:
            ends = max(moved - 2.0 * error, 0.0), max(moved + 2.0 * error, jumps)
            methods.append(_method("plain", ends, np.zeros((spread.size, 2)), norm, 1, slope))
        if is_finite.all():
            methods += [
                _method("gradient", (low, high), up, norm, 1, slope),
                _method("mirrored", (low, high), slopes, norm, 2, slope),
            ]
        methods.sort(key=lambda m: (math.isnan(m.seconds), m.seconds))
    return Smoothed(
        sigma,
        truth / weight[:, 0],
        error,
        norm,
        pairs,
        bias=bias,
        bias_low=low,
        bias_high=high,
        moved=moved,
        remark=remark,
        methods=tuple(methods),
        n_moved=int((d != 0.0).sum()),
        n_lost=n_lost,
        unseen=event,
    )


def _terms(u: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return terms ``(d, n)`` with expectation E[d u], less variable thanks to a line fitted to the other half."""
    dim, count = u.shape
    halves = np.arange(count) % 2 == 0
    out = np.empty_like(u)
    for half in (halves, ~halves):
        slope = np.zeros(dim)
        if half.sum() > 3 * dim:
            slope = np.linalg.lstsq(u[:, ~half].T, d[~half], rcond=None)[0]
        out[:, half] = (d[half] - slope @ u[:, half]) * u[:, half] + slope[:, None]
    return out


def _means(terms: np.ndarray) -> np.ndarray:
    """Return independent means of ``terms (d, n)``, ``(GROUPS, d)``, each over equally many terms of both halves."""
    return terms.reshape(terms.shape[0], GROUPS, -1).mean(axis=2).T


def _method(name: str, bias: tuple[float, float], terms: np.ndarray, norm: float, calls: int, seconds: float) -> Method:
    variance = float(terms.var(axis=1, ddof=1).sum())
    low, high = (end / norm for end in bias)
    room = TARGET_ERROR**2 - high**2
    samples = math.inf if low >= TARGET_ERROR else math.nan
    if room > 0:
        samples = max(1.0, math.ceil(variance / norm**2 / room))
    return Method(name, high, samples, calls * samples, calls * samples * seconds)


def largest_unseen(lines: Sequence[LineScan], ratio: float, draws: int) -> tuple[float, float]:
    """Return the largest parts of ``sigma * grad J`` that ``draws`` draws of the noise may miss, from costs on lines.

    ``ratio`` is sigma over that of the lines. Across a plane at t standard deviations, a change of the cost by H is a part
    ``H phi(t)``. The first part is that of the jumps on a line that fewer than :data:`RARE` draws meet. The second is that of an
    event that no line and no draw meets, as likely as 5% of cases allow and as high as the range of the cost on the lines.
    """
    normal, jumps, events = NormalDist(), [0.0], [0.0]
    for line in lines:
        inside = line.costs[(np.abs(line.at / ratio) <= REACH) & np.isfinite(line.costs)]
        events.append(float(np.ptp(inside)) * normal.pdf(normal.inv_cdf(UNMET / draws)) if inside.size else 0.0)
        at = [(abs(jump.at / ratio), jump.size) for jump in line.jumps]
        jumps.append(sum(size * normal.pdf(t) for t, size in at if draws * normal.cdf(-t) < RARE))
    return max(jumps), max(events)


def directions(count: int, scale: np.ndarray, seed: int) -> np.ndarray:
    """Return random directions ``(count, d)`` of length 1 in units of ``scale``; only one direction where d is 1."""
    if scale.size == 1:
        return scale[None, :]
    drawn = np.random.default_rng([seed, 0x6C696E65]).standard_normal((count, scale.size))
    return scale * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
