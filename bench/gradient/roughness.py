"""Estimates a cost's computational noise, and detects whether the cost is a staircase."""

from __future__ import annotations

from math import factorial

import numpy as np

POINTS = 8
"""Points on either side of theta from which the noise is estimated."""
SPACING = 64.0
"""Least spacing of the points for the noise, in units of the input's unit roundoff."""
FINE = 1.37e-11
"""Default spacing of the points for the noise, relative to the input's scale: below the smallest step, and not round."""
SCAN = 65
"""Points of a scan for a staircase."""
EDGES = 3
"""Fewest isolated edges of a staircase; with fewer, the cost has single jumps."""
APART = 3.0
"""Least ratio of an edge to the variation of increments on the treads."""
STOPPED = 513
"""Points of a scan for jumps of a solver that stops early."""
REACHES = (1.0, 0.5, 0.25, 0.1, 0.05, 0.02)
"""Distances of the scans on either side of theta, in units of the input's scale. Jumps too dense for a wide scan show on a narrow one."""
SIXTH, IMPULSE, CLEAR = 6, 10.0, 50.0
"""Order of the differences that show jumps, the largest of a unit jump, and the ratio to their median of a jump."""
STOPS = 3
"""Fewest jumps of a solver that stops early; fewer may be a contact."""
SMALL = 1e-3
"""Largest sum of such jumps, as a share of the cost's range on the scan."""


def offsets(unit: float) -> np.ndarray:
    """Return the displacements, relative to an input's scale, at which :func:`noise` needs the cost, ``(2, POINTS)``.

    The centre belongs to neither side, so a jump exactly at theta does not affect the estimate. The two sides have
    different spacings, so no ripple looks smooth on both.
    """
    side = max(SPACING * unit, FINE) * np.arange(1, POINTS + 1)
    return np.stack([-side, np.sqrt(3.0) * side])


def noise(values: np.ndarray) -> float:
    """Return the standard deviation of the noise in equally spaced ``values (..., n)``, the largest over the rows.

    Differences of order k cancel the smooth part and multiply the variance of independent noise by (2k)! / (k!)^2
    (More and Wild 2011, SIAM J. Sci. Comput. 33, equation 2.4). The result is the least over orders 3 to 5, since a
    remaining smooth part only adds to it.
    """
    if not np.isfinite(values).all():
        return float("inf")
    exponent = np.frexp(np.abs(values).max())[1]
    values, levels = np.ldexp(values, -exponent), []  # a square of a huge number is infinite
    for order in (3, 4, 5):
        scale = factorial(order) ** 2 / factorial(2 * order)
        levels.append(np.sqrt(scale * np.mean(np.diff(values, order, axis=-1) ** 2, axis=-1)))
    return float(np.ldexp(np.max(np.min(levels, axis=0)), exponent))


def scatter(step: np.ndarray, differences: np.ndarray) -> float:
    """Return the noise of the cost from its central differences at falling steps, both ``(K,)``; 0 without visible noise.

    Noise moves the differences up and down by its size over the step. A jump, a kink or curvature moves the differences
    in one direction, or less with each step, and does not count.
    """
    moved = (np.diff(differences) * step[1:])[-POINTS:]
    size = np.abs(moved)
    if not np.isfinite(size).all() or not size.all():
        return 0.0
    middle = float(np.median(size))
    turns = np.count_nonzero(np.diff(np.sign(moved)))
    return middle if turns >= POINTS // 2 and size.max() <= 10.0 * middle else 0.0


def staircase_offsets(unit: float) -> np.ndarray:
    """Return displacements ``(7, SCAN)`` for :func:`is_staircase`, at seven spacings a decade apart."""
    return np.outer(np.sqrt(unit) * 10.0 ** np.arange(-2.0, 5.0), np.arange(SCAN))


def is_staircase(values: np.ndarray, rounding: float) -> bool:
    """Return whether equally spaced ``values (n,)`` lie on a staircase, possibly added to a straight line.

    On a staircase most increments are equal to within ``rounding``. The others are isolated and exceed the remaining
    variation by a factor of :data:`APART`. Not staircases: a single jump, a slope with a flat part, and rounding
    amplified by a rollout, whose increments have every size.
    """
    if not np.isfinite(values).all():
        return False
    increments = np.diff(values)
    tread = float(np.median(increments))
    change = np.abs(increments - tread)
    edge = change > rounding + 1e-3 * np.abs(increments).max()
    if edge.all() or not edge.any() or change[edge].min() <= APART * change[~edge].max():
        return False
    apart = edge & ~np.r_[False, edge[:-1]] & ~np.r_[edge[1:], False]
    return bool(apart.sum() >= EDGES and apart.sum() >= 0.9 * edge.sum())


def stopping_rate(values: np.ndarray, length: float, rounding: float) -> float:
    """Return the sum of jumps per unit length in equally spaced ``values (n,)``; 0 unless jumps are small and at least 3.

    An iterative solver needs one iteration more or less at some inputs, where the cost jumps by about its tolerance. Between
    the jumps, the slope of the cost is the derivative of a fixed number of iterations. It differs from the derivative of
    the solution by about this rate.
    """
    if not np.isfinite(values).all():
        return 0.0
    sizes = np.abs(np.diff(values, SIXTH))
    high = sizes > CLEAR * float(np.median(sizes)) + 2.0**SIXTH * rounding
    # a jump raises neighbouring differences
    starts = np.flatnonzero(high & ~np.r_[False, high[:-1]])
    jumps = np.array([sizes[start : start + SIXTH].max() for start in starts]) / IMPULSE
    if jumps.size < STOPS or jumps.sum() > SMALL * np.ptp(values):
        return 0.0
    return float(jumps.sum() / length)
