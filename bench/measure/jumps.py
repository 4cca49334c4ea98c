"""Looks for jumps of a cost along lines, by cutting the places of largest bend again and again."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

PARTS = 64
"""Intervals that each line is cut into at first."""
CUTS = 32
"""Intervals that a suspected one, and its neighbour, are cut into at every further level."""
SUSPECTS = 32
"""Places followed at once."""
FINEST = 1e-11
"""Length, as a share of the line, at which a change that has not fallen is a jump."""
NO_JUMP = 1e-6
"""Change of a cost, relative to its range on the lines, below which rounding may keep it from falling further."""
LOUD = 100.0
"""Multiple of the cost's rounding noise below which a change is taken for noise."""


def largest_jump(cost: Callable[[np.ndarray], np.ndarray], starts: np.ndarray, ends: np.ndarray) -> float:
    """Return the largest jump of ``cost`` on the lines from ``starts (n, L)`` to ``ends (n, L)``; 0 without one.

    ``cost`` maps points ``(n, B)`` to ``(B,)``. Where a smooth cost is cut into parts of length h its second difference
    falls as h^2, at a kink as h, and at a jump it stays. Jumps below 1e-6 of the cost's range on the lines, between the
    nodes of a line that both its sides equal, or in places that more than :data:`SUSPECTS` others outdo, are not seen.
    Values that are not finite are passed over.
    """
    count = starts.shape[1]
    line = np.arange(count)
    left, width, parts = np.zeros(count), 1.0, PARTS
    span = noise = 0.0
    changes = [0.0]
    while True:
        nodes = left[:, None] + width * np.linspace(0.0, 1.0, parts + 1)
        at = np.repeat(line, parts + 1)
        values = cost(starts[:, at] + (ends[:, at] - starts[:, at]) * nodes.ravel()).reshape(nodes.shape)
        values = np.where(np.isfinite(values), values, np.nan)
        if not np.isfinite(values).any():
            return 0.0
        span = max(span, float(np.nanmax(values) - np.nanmin(values)))
        steps = np.nan_to_num(np.abs(np.diff(values, axis=1)))
        bends = np.nan_to_num(np.abs(np.diff(values, 2, axis=1)))
        changes.append(float(steps.max()))
        if width / parts < FINEST:
            # at this length all but a jump is rounding
            noise = float(np.median(bends))
            break
        row, place = np.unravel_index(np.argsort(bends, axis=None)[-SUSPECTS:], bends.shape)
        line, left, width, parts = line[row], nodes[row, place], 2.0 * width / parts, CUTS
    stays = changes[-1] > 0.1 * changes[-2] and changes[-1] > max(NO_JUMP * span, LOUD * noise)
    return changes[-1] if stays else 0.0
