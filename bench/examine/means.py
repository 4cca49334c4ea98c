"""Compares the mean of a gradient over draws of the simulator's own noise with that of the cost's differences.

A gradient under own noise w may be an estimator: it is not the derivative of the cost at each w, and its mean is that of the
mean cost. Draws of the cost's differences have the same w on both sides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bench.examine.stages import GradientStages
from bench.gradient.rules import UNEQUAL
from bench.simulator.clock import OutOfTime

FIRST, ENOUGH, MOST = 16, 256, 65536
"""Draws of the first round, those that can decide, and those of all; each round doubles them."""
ALONG = 4
"""Most directions of theta in which slopes are compared."""
WIDE = 0.1
"""Step of the wide differences, in units of each input's scale: they include jumps, which small ones do not."""
CLEAR = 4.0
"""Standard errors from which a mean is not 0."""
ALIKE = 0.05
"""Largest relative distance of the mean wide difference from the small one where the cost has no jumps."""
SAME = 0.01
"""Largest share of the mean square of a gradient that a multiple of the slopes of the draws leaves, where it follows them."""
RIGHT = 0.1
"""Largest relative error of a mean that is right."""
HELD = 20_000_000
"""Most numbers in the thetas of more draws than :data:`ENOUGH`."""
CONTROLLED = 20
"""Fewest draws per control variate."""
OF_A_DRAW = (*UNEQUAL, "staircase", "stale_gradient")
"""Verdicts at a fixed draw that the mean of an estimator overrules."""


@dataclass(frozen=True)
class Mean:
    """The mean of a gradient over draws of w, against that of the cost's differences along a few directions."""

    draws: int
    error: float
    """Distance of the means, relative to that of the differences; infinite where that may be 0."""
    doubt: float
    """Twice its standard error."""
    is_of_draws: bool
    """Whether the gradient follows the slope of each draw, so that its error is no randomness of an estimator."""
    has_jumps: bool
    """Whether jumps carry a part of the mean slope, so that small differences do not show it."""
    is_smooth: bool
    """Whether it is known that they carry none."""
    n_lost: int = 0
    """Number of draws with a gradient that is not a number, where the costs are numbers."""

    @property
    def is_decisive(self) -> bool:
        """Whether the draws are enough, and small differences show the mean slope, or a gradient is not a number."""
        return self.n_lost > 0 or (self.draws >= ENOUGH and self.is_smooth)

    @property
    def cause(self) -> str:
        """The verdict on the mean: ``nan_gradient``, ``estimator``, ``biased`` or ``spread``; the last three only without jumps."""
        if self.n_lost:
            return "nan_gradient"
        if 2.0 * self.error > CLEAR * self.doubt:
            return "biased"
        return "estimator" if self.error + self.doubt <= RIGHT else "spread"


def compare_means(stages: GradientStages) -> Mean:
    """Return the comparison with as many draws as decide it and the clock's limit allows; raises :class:`OutOfTime` with less than a round."""
    size, random = stages.theta.size, np.random.default_rng([stages.seed, 0x6D65616E])
    vectors = np.eye(size) if size <= ALONG else random.standard_normal((size, ALONG))
    vectors = stages.scale[:, None] * vectors / np.linalg.norm(vectors, axis=0)
    rows: list[np.ndarray] = []
    count, result = FIRST, None
    try:
        while result is None or (result.draws < min(MOST, max(ENOUGH, HELD // size)) and not result.has_jumps):
            w = random.standard_normal((stages.simulator.noise, count))
            rows.append(np.concatenate([w, _slopes(stages, vectors, w)]))
            result = _summary(np.concatenate(rows, axis=1), stages.simulator.noise)
            if result.is_decisive and result.cause != "spread":
                break
            count = result.draws
    except OutOfTime:
        if result is None:
            raise
    return result


def _slopes(stages: GradientStages, vectors: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the slopes along ``vectors (d, m)`` for each ``w (n, K)``: of the gradient, by small and by wide steps, ``(3 m, K)``."""
    theta, count = stages.theta[:, None], w.shape[1]
    rows = [vectors.T @ stages.simulator.gradients(np.repeat(theta, count, axis=1), w)]
    for step in (float(np.cbrt(stages.simulator.unit)), WIDE):
        for vector in vectors.T:
            sides = (np.repeat(theta + sign * step * vector[:, None], count, axis=1) for sign in (1.0, -1.0))
            up, down = (stages.simulator.costs(side, w) for side in sides)
            rows.append((up - down)[None] / (2.0 * step))
    return np.concatenate(rows)


@np.errstate(all="ignore")
def _summary(drawn: np.ndarray, n_noise: int) -> Mean:
    w, slopes = drawn[:n_noise], drawn[n_noise:]
    gradient, small, wide = np.split(slopes, 3)
    n_lost = int((np.isfinite(small).all(axis=0) & ~np.isfinite(gradient).all(axis=0)).sum())
    if n_lost:
        return Mean(drawn.shape[1], math.inf, math.inf, False, False, False, n_lost)
    apart, beyond = gradient - small, wide - small
    mean, error = _mean(apart, w)
    jump, jump_error = _mean(beyond, w)
    slope, slope_error = _mean(small, w)
    size = max(slope - 2.0 * slope_error, 0.0)
    distance, doubt = (
        np.array([math.sqrt(max(mean**2 - error**2, 0.0)), 2.0 * error]) / size if size > 0 else [math.inf] * 2
    )
    return Mean(
        drawn.shape[1],
        float(distance),
        float(doubt),
        all(map(_follows, gradient, small)),
        jump > CLEAR * jump_error and jump > ALIKE * size,
        jump + 2.0 * jump_error <= ALIKE * size,
    )


def _follows(gradient: np.ndarray, small: np.ndarray) -> bool:
    """Return whether a gradient ``(K,)`` is a multiple of the slopes of the draws ``(K,)``, along one direction."""
    own, square = float(np.mean(gradient**2)), float(np.mean(small**2))
    return (1.0 - SAME) * own * square <= float(np.mean(gradient * small)) ** 2 and (square > 0.0 or own == 0.0)


def _mean(values: np.ndarray, w: np.ndarray) -> tuple[float, float]:
    """Return the norm of the mean of ``values (m, K)`` and its standard error, less variable by w and w^2, whose means are known."""
    count = values.shape[1]
    controls = np.concatenate([np.ones((1, count)), w, w * w - 1.0])
    if count < CONTROLLED * len(controls):
        controls = controls[:1]
    fit, *_ = np.linalg.lstsq(controls.T, values.T, rcond=None)
    rest = values - (controls.T @ fit).T
    return float(np.linalg.norm(fit[0])), float(np.sqrt(rest.var(axis=1).sum() / (count - len(controls))))
