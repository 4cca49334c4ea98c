"""The slope of a rough cost's smooth part, from wide steps: adaptive and iterative solvers change their steps with theta.

At tiny steps the slope of such a cost is that of one sequence of steps, at wide ones that of the solution. Per scale h, a
quadratic through costs at random displacements within h gives a slope, its standard error, and the scatter around the
fit. The cost is rough at a scale where the scatter exceeds rounding and does not fall like h^3. The slope of least error
among the scales where the scatter has reached a tenth of its largest value is that of the smooth part.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .direction import Function

SCALES = np.logspace(-1, -9, 17)
"""Scales, two per decade, in units of the input's scale."""
POINTS = 17
"""Costs per scale."""
FALL = 6.0
"""Ratio of the scatter at a scale to that at a tenth of it, from which on it is that of a kink or of a smooth cost's curvature."""
FIRST = np.array([2, 4, 6, 8])
"""Scales that are tried first: without roughness at these, a cost is not rough."""
STILL = 4
"""Smallest scales at which a rough cost moves, and a staircase does not."""
ROUGH = 100.0
"""Multiple of the cost's rounding error above which scatter is roughness."""
SATURATED = 0.1
"""Least scatter, relative to the largest, of the scales whose slopes count."""
SPREAD = 3.0
"""Standard errors that count as the error of a slope."""
LIMIT = 0.1
"""Largest relative error of a slope that decides."""
CLEAR = 2.0
"""Least distance of a wrong derivative from a slope, in multiples of its error, which scatter does not bound."""
COSTS = POINTS * SCALES.size
"""Costs for one component."""


class SmoothPart(NamedTuple):
    """The slope of a cost's smooth part along one input."""

    slope: float
    error: float
    """Its standard error, and its change from the next wider scale."""


def smooth_part(along: Function, scale: float, unit: float, random: np.random.Generator) -> SmoothPart | None:
    """Return the slope of the smooth part of ``along(t)``, ``(n,)`` to ``(n,)``; None for a cost that is not rough.

    A cost that repeats exactly at tiny steps is a staircase and not rough: it has no smooth part that the program knows.
    """
    steps = SCALES * scale
    drawn = random.uniform(-1.0, 1.0, (steps.size, POINTS))
    fits = np.full((steps.size, 4), np.nan)
    for part in (FIRST, np.setdiff1d(np.arange(steps.size), FIRST)):
        costs = along((steps[part, None] * drawn[part]).ravel()).reshape(-1, POINTS)
        if not np.isfinite(costs).all():
            return None
        fits[part] = [_fit(h, t, f) for h, t, f in zip(steps[part], drawn[part], costs, strict=True)]
        floor = ROUGH * 4.0 * unit * float(np.abs(costs).max())
        scatters = fits[:, 2]
        # a smooth cost's scatter falls by 1,000 per decade, at a kink by 10; comparisons with scales that are not known are false
        rough = [j for j in range(steps.size - 2) if scatters[j] > floor and scatters[j] < FALL * scatters[j + 2]]
        if not rough:
            return None
    if (fits[-STILL:, 3] == 0.0).any():
        return None
    slopes, errors = fits[:, 0], fits[:, 1]
    most = scatters[rough].max()
    # the widest scale has no wider one that bounds its curvature
    error = SPREAD * errors + np.abs(np.diff(slopes, prepend=np.inf)) / 2.0
    best = min((j for j in rough if scatters[j] >= SATURATED * most), key=lambda j: error[j])
    return SmoothPart(float(slopes[best]), float(error[best]))


def _fit(h: float, t: np.ndarray, costs: np.ndarray) -> tuple[float, float, float, float]:
    """Return slope, its standard error, scatter and range of ``costs (n,)`` at displacements ``h * t``, by a quadratic."""
    basis, rise = np.stack([np.ones_like(t), t, t * t], axis=1), costs - costs[0]
    fit, *_ = np.linalg.lstsq(basis, rise, rcond=None)
    scatter = float(np.sqrt(((rise - basis @ fit) ** 2).sum() / (POINTS - 3)))
    error = scatter * float(np.sqrt(np.linalg.inv(basis.T @ basis)[1, 1]))
    return float(fit[1]) / h, error / h, scatter, float(np.ptp(costs))
