"""How rough a cost is at the smallest scale: the size of its computational noise, and whether it is a staircase."""

from __future__ import annotations

from math import factorial

import numpy as np

POINTS = 8
"""Points on either side of theta from which the noise is estimated."""
SPACING = 64.0
"""Least distance of those points, in units in the last place of the input."""
FINE = 1.37e-11
"""Their distance otherwise, relative to the input's scale: below the smallest step, and no round number."""
SCAN = 65
"""Points of a scan for the treads of a staircase."""
EDGES = 3
"""Separate edges from which a run of treads counts as a staircase, and not as a jump or two."""
APART = 3.0
"""Least ratio of an edge to what the increments on the treads differ by."""


def offsets(unit: float) -> np.ndarray:
    """Return the displacements, relative to an input's scale, at which :func:`noise` wants the cost, ``(2, POINTS)``.

    The centre belongs to neither side, so that a jump exactly at theta is in no estimate. The two sides are spaced
    differently, so that no ripple looks smooth on both.
    """
    side = max(SPACING * unit, FINE) * np.arange(1, POINTS + 1)
    return np.stack([-side, np.sqrt(3.0) * side])


def noise(values: np.ndarray) -> float:
    """Return the standard deviation of the noise in equally spaced ``values (..., n)``, the largest of all rows.

    Differences of order k cancel what is smooth and multiply the variance of independent noise by (2k)! / (k!)^2
    (More and Wild 2011, SIAM J. Sci. Comput. 33, equation 2.4). The least over orders 3 to 5 is taken, as a smooth part
    that is left adds to it.
    """
    if not np.isfinite(values).all():
        return float("inf")
    levels = []
    for order in (3, 4, 5):
        scale = factorial(order) ** 2 / factorial(2 * order)
        levels.append(np.sqrt(scale * np.mean(np.diff(values, order, axis=-1) ** 2, axis=-1)))
    return float(np.max(np.min(levels, axis=0)))


def scatter(step: np.ndarray, differences: np.ndarray) -> float:
    """Return the noise of the cost by its central differences over falling steps ``(K,)``; 0 where they show none.

    Noise moves the differences to and fro by its size over the step. What moves them one way only, or less with each
    step, is no noise: a jump, a kink, a bend.
    """
    moved = (np.diff(differences) * step[1:])[-POINTS:]
    size = np.abs(moved)
    if not np.isfinite(size).all() or not size.all():
        return 0.0
    middle = float(np.median(size))
    turns = np.count_nonzero(np.diff(np.sign(moved)))
    return middle if turns >= POINTS // 2 and size.max() <= 10.0 * middle else 0.0


def staircase_offsets(scale: float, unit: float) -> np.ndarray:
    """Return displacements for :func:`is_staircase` at seven spacings, a decade apart, ``(7, SCAN)``."""
    spacings = np.sqrt(unit) * 10.0 ** np.arange(-2.0, 5.0) * scale
    return spacings[:, None] * np.arange(SCAN)


def is_staircase(values: np.ndarray, rounding: float) -> bool:
    """Return whether equally spaced ``values (n,)`` lie on a staircase, perhaps one that is added to a straight line.

    Most increments are then the same to within ``rounding``, and the others stand out of it one by one, by
    :data:`APART` times what is left. A single jump is no staircase, neither is a slope with a flat part, and neither is
    rounding that a rollout amplifies: its increments have every size.
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
