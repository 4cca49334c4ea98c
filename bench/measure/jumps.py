"""Finds the largest jump of a cost along lines, by refining the intervals in which the cost bends most."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

PARTS = 64
"""Default number of intervals of each line at the first level."""
CUTS = 32
"""Number of intervals into which a suspicious interval and its neighbour are divided at every further level."""
SUSPECTS = 32
"""Number of intervals refined at each level."""
FINEST = 1e-11
"""Interval length, as a share of the line, at which a change of the cost that no longer shrinks is a jump."""
NO_JUMP = 1e-6
"""Change of a cost, relative to its range on the lines, below which rounding may hide that the change still shrinks."""
LOUD = 100.0
"""Multiple of the cost's rounding noise below which a change counts as noise."""
SINGLE = float(np.finfo(np.float32).eps)
"""Relative rounding of a cost computed in single precision, whose values are all single-precision numbers."""


class Jump(NamedTuple):
    """The largest jump of a cost on some lines."""

    height: float
    """Change of the cost across the jump; 0 without a jump."""
    span: float
    """Range of the cost on the lines."""


def largest_jump(
    cost: Callable[[np.ndarray], np.ndarray], starts: np.ndarray, ends: np.ndarray, parts: int = PARTS
) -> Jump:
    """Return the largest jump of ``cost`` on the lines from ``starts (n, L)`` to ``ends (n, L)``.

    ``cost`` maps points ``(n, B)`` to ``(B,)``. As intervals of length h shrink, the second difference of a smooth cost
    falls as h^2, at a kink as h, and at a jump it is constant. Three kinds of jumps are missed: jumps below 1e-6 of the
    cost's range on the lines, jumps between two of the first ``parts`` + 1 nodes of a line that do not change the cost
    at these nodes, and jumps in an interval whose second difference more than :data:`SUSPECTS` other intervals exceed.
    Values that are not finite are ignored.
    """
    count = starts.shape[1]
    line = np.arange(count)
    left, width = np.zeros(count), 1.0
    span = noise = size = 0.0
    single = True
    changes = [0.0]
    while True:
        nodes = left[:, None] + width * np.linspace(0.0, 1.0, parts + 1)
        at = np.repeat(line, parts + 1)
        values = cost(starts[:, at] + (ends[:, at] - starts[:, at]) * nodes.ravel()).reshape(nodes.shape)
        values = np.where(np.isfinite(values), values, np.nan)
        if not np.isfinite(values).any():
            return Jump(0.0, span)
        known = values[np.isfinite(values)]
        single = single and bool((known == known.astype(np.float32)).all())
        size = max(size, float(np.abs(known).max()))
        span = max(span, float(np.nanmax(values) - np.nanmin(values)))
        steps = np.nan_to_num(np.abs(np.diff(values, axis=1)))
        bends = np.nan_to_num(np.abs(np.diff(values, 2, axis=1)))
        changes.append(float(steps.max()))
        if width / parts < FINEST:
            # at this length only a jump exceeds rounding
            noise = float(np.median(bends))
            break
        row, place = np.unravel_index(np.argsort(bends, axis=None)[-SUSPECTS:], bends.shape)
        line, left, width, parts = line[row], nodes[row, place], 2.0 * width / parts, CUTS
    if single:
        # steps of rounding are flat at the last level, so that they have no median bend
        noise = max(noise, SINGLE * size)
    stays = changes[-1] > 0.1 * changes[-2] and changes[-1] > max(NO_JUMP * span, LOUD * noise)
    return Jump(changes[-1] if stays else 0.0, span)
