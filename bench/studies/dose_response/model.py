"""Fits how the number of updates grows with the error of a gradient, from searches that may miss their target.

The model of a search on problem g with relative spread s and bias b of its gradient is

    log updates = a_g + log(1 + c_s s^p + c_b b^p) + effects + scatter z,

the form of large-batch training (McCandlish et al. 2018, arXiv 1812.06162, equation 2.11: steps = S_min (1 + B_noise / B)),
in which the squared spread of a mean of B samples is B_noise / B, so p = 2. A missed target contributes the probability of more
updates than were made (a Tobit likelihood: Tobin 1958). The scatter z is normal, or an extreme value (a Weibull time) in a
second analysis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_ndtr, stdtrit

Form = Literal["floor", "power", "none"]
"""``floor``: 1 + c x^p; ``power``: x^p, without a floor; ``none``: no effect of the error."""
Scatter = Literal["normal", "extreme"]
LEAST = 0.01
"""Smallest error of the power law, which has no value at 0."""
BOUNDS = {"c": (-9.0, 9.0), "p": (0.1, 6.0), "scatter": (-4.0, 3.0), "effect": (-6.0, 6.0)}
"""Ranges of log c, p, log scatter and effects."""


@dataclass(frozen=True)
class Data:
    """Searches of several problems, one element each."""

    problem: np.ndarray
    """Number of the problem, from 0."""
    log_time: np.ndarray
    """Log of the updates; of the updates made, where the target was missed."""
    is_missed: np.ndarray
    errors: np.ndarray
    """The errors with a coefficient each, ``(n, k)``: spread and bias, or a single predictor."""
    weight: np.ndarray
    effects: np.ndarray
    """Columns with an effect on log time each, such as indicators of methods: ``(n, m)``."""

    @property
    def n_problems(self) -> int:
        """The number of problems."""
        return int(self.problem.max()) + 1 if self.problem.size else 0

    def of(self, problems: np.ndarray) -> Data:
        """Return the searches of problems, which may repeat; they are numbered again from 0 in the given order."""
        places = [np.flatnonzero(self.problem == g) for g in problems]
        index = np.concatenate(places) if places else np.empty(0, dtype=int)
        numbers = np.repeat(np.arange(len(places)), [len(place) for place in places])
        return Data(
            numbers,
            self.log_time[index],
            self.is_missed[index],
            self.errors[index],
            self.weight[index],
            self.effects[index],
        )


@dataclass(frozen=True)
class Fit:
    """A fitted model."""

    floors: np.ndarray
    """a_g, log of the updates without an error, by problem."""
    log_c: np.ndarray
    power: float
    log_scatter: float
    effects: np.ndarray
    likelihood: float
    form: Form
    scatter: Scatter

    @property
    def is_identified(self) -> bool:
        """Whether the power lies inside its bounds: at a bound the errors do not determine it."""
        low, high = BOUNDS["p"]
        return self.form != "floor" or 1.05 * low < self.power < high / 1.05

    def growth(self, *errors: float) -> float:
        """Return the updates at these errors, one per coefficient, over the updates without an error."""
        x = np.asarray(errors, dtype=float)
        if self.form == "none":
            return 1.0
        if self.form == "power":
            return float(np.prod(np.maximum(x, LEAST) ** self.power))
        return float(1.0 + (np.exp(self.log_c) * x**self.power).sum())


def fit(data: Data, form: Form = "floor", scatter: Scatter = "normal", start: Fit | None = None) -> Fit:
    """Return the maximum-likelihood fit. Raises ValueError without a search that reached its target."""
    if data.is_missed.all():
        raise ValueError("no search reached its target, so nothing can be fitted")
    groups, k, m = data.n_problems, data.errors.shape[1], data.effects.shape[1]
    first = _floors_at_start(data)
    starts = [np.r_[first, np.zeros(k), p, -0.5, np.zeros(m)] for p in ((1.0, 2.0) if form == "floor" else (1.0,))]
    if start is not None:
        floors = start.floors if start.floors.size == groups else first
        starts = [np.r_[floors, start.log_c, start.power, start.log_scatter, start.effects]]
    limits = [(None, None)] * groups + [BOUNDS["c"]] * k + [BOUNDS["p"], BOUNDS["scatter"]] + [BOUNDS["effect"]] * m
    ends = [
        minimize(
            _negative,
            x,
            (data, form, scatter),
            jac=True,
            method="L-BFGS-B",
            bounds=limits,
            options={"maxiter": 300, "ftol": 1e-8},
        )
        for x in starts
    ]
    best = min(ends, key=lambda end: end.fun)
    a, log_c, (p, log_scatter), effects = np.split(best.x, [groups, groups + k, groups + k + 2])
    return Fit(a, log_c, float(p), float(log_scatter), effects, -float(best.fun), form, scatter)


def _floors_at_start(data: Data) -> np.ndarray:
    total = np.bincount(data.problem, data.weight)
    return np.asarray(np.bincount(data.problem, data.weight * data.log_time) / total) - 0.5


def _negative(x: np.ndarray, data: Data, form: Form, scatter: Scatter) -> tuple[float, np.ndarray]:
    """Return the negative log likelihood and its derivative by all parameters."""
    groups, k = data.n_problems, data.errors.shape[1]
    a, log_c, (p, log_s), effects = np.split(x, [groups, groups + k, groups + k + 2])
    raised, slopes = _raised(data.errors, form, p)
    if form == "floor":
        terms = np.exp(log_c) * raised
        total = 1.0 + terms.sum(axis=1)
        growth, by_c = np.log(total), terms / total[:, None]
        by_p = (terms * slopes).sum(axis=1) / total
    elif form == "power":
        growth, by_c, by_p = p * slopes.sum(axis=1), np.zeros_like(raised), slopes.sum(axis=1)
    else:
        growth, by_c, by_p = np.zeros(len(raised)), np.zeros_like(raised), np.zeros(len(raised))
    s = np.exp(log_s)
    z = (data.log_time - a[data.problem] - growth - data.effects @ effects) / s
    value, by_z = _likelihood(z, log_s, data.is_missed, scatter)
    w = data.weight
    by_mean = -w * by_z / s  # derivative of the log likelihood by the mean
    gradient = np.r_[
        np.bincount(data.problem, by_mean, minlength=groups), by_mean @ by_c, by_mean @ by_p,
        (w * (-by_z * z - ~data.is_missed)).sum(), by_mean @ data.effects,
    ]  # fmt: skip
    return -float((w * value).sum()), -gradient


def _raised(errors: np.ndarray, form: Form, p: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors to the power p and their logs, with a log of 0 where an error is 0 and so has no effect."""
    floor = LEAST if form == "power" else 0.0
    x = np.maximum(errors, floor)
    logs = np.log(np.where(x > 0, x, 1.0))
    return np.where(x > 0, np.exp(p * logs), 0.0), logs


def _likelihood(z: np.ndarray, log_s: float, is_missed: np.ndarray, scatter: Scatter) -> tuple[np.ndarray, np.ndarray]:
    """Return each search's log likelihood, and its derivative by z."""
    if scatter == "normal":
        survival = log_ndtr(-z)
        hazard = np.exp(-0.5 * z**2 - 0.5 * np.log(2 * np.pi) - survival)
        reached, by_z = -0.5 * z**2 - 0.5 * np.log(2 * np.pi) - log_s, -z
    else:  # the log of a Weibull time: P(Z > z) = exp(-exp(z))
        hazard = np.exp(np.minimum(z, 50.0))
        survival = -hazard
        reached, by_z = z - hazard - log_s, 1.0 - hazard
    return np.where(is_missed, survival, reached), np.where(is_missed, -hazard, by_z)


def bootstrap(data: Data, fitted: Fit, repeats: int, seed: int = 0) -> list[Fit]:
    """Return fits of resampled problems, all searches of a problem together."""
    rng = np.random.default_rng(seed)
    fits = []
    for _ in range(repeats):
        problems = rng.integers(0, data.n_problems, data.n_problems)
        drawn = data.of(problems)
        if not drawn.is_missed.all():
            near = replace(fitted, floors=fitted.floors[problems])
            fits.append(fit(drawn, fitted.form, fitted.scatter, near))
    return fits


def left_out_likelihoods(data: Data, form: Form, scatter: Scatter = "normal") -> np.ndarray:
    """Return each problem's log likelihood per search, ``(problems,)``, by a model fitted to the other problems.

    Only the left-out problem's own number of updates without an error is fitted to it. NaN where nothing can be fitted.
    """
    result = np.full(data.n_problems, np.nan)
    for g in range(data.n_problems):
        others = data.of(np.array([i for i in range(data.n_problems) if i != g], dtype=int))
        own = data.of(np.array([g]))
        if others.is_missed.all() or own.is_missed.all():
            continue
        model = fit(others, form, scatter)
        tail = np.r_[model.log_c, model.power, model.log_scatter, model.effects]

        def negative(a: np.ndarray, own: Data = own, tail: np.ndarray = tail) -> tuple[float, np.ndarray]:
            value, gradient = _negative(np.r_[a, tail], own, form, scatter)
            return value, gradient[:1]

        end = minimize(negative, _floors_at_start(own), jac=True, method="L-BFGS-B")
        result[g] = -end.fun / own.weight.sum()
    return result


@dataclass(frozen=True)
class Estimate:
    """A quantity with its 95% interval over problems, and the number of problems."""

    value: float
    low: float
    high: float
    n: int

    def verdict(self, low: float, high: float) -> str:
        """Return ``inside``, ``below`` or ``above`` where the interval lies so with respect to low and high, else ``open``."""
        if self.low > high:
            return "above"
        if self.high < low:
            return "below"
        return "inside" if low <= self.low and self.high <= high else "open"

    def problems_needed(self, boundary: float) -> float:
        """Return the problems at which the interval would exclude a positive boundary, with 80% power; NaN if unknown.

        The spread of the logarithm over bootstrap samples falls as one over the square root of the number of problems.
        """
        ends = np.array([self.low, self.value, self.high, boundary])
        if not (np.isfinite(ends).all() and (ends > 0).all()) or self.value == boundary:
            return float("nan")
        deviation = np.log(self.high / self.low) / (2 * 1.96)
        return float(self.n * ((1.96 + 0.84) * deviation / np.log(self.value / boundary)) ** 2)


def estimate(value: float, draws: Sequence[float], n: int) -> Estimate:
    """Return a positive quantity with its interval: the bootstrap's standard error of its logarithm times Student's t.

    With few problems, quantiles of bootstrap values are too narrow. The interval is infinite for fewer than 3 problems.
    """
    logs = np.log([draw for draw in draws if np.isfinite(draw) and draw > 0])
    if n < 3 or logs.size < 10 or not value > 0:
        return Estimate(value, 0.0, np.inf, n)
    reach = float(stdtrit(n - 1, 0.975) * logs.std(ddof=1) * np.sqrt(n / (n - 1)))
    return Estimate(value, float(value * np.exp(-reach)), float(value * np.exp(reach)), n)
