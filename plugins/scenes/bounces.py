"""The exact motion of a body that bounces on a rigid surface, and its derivative, for scenes whose physics it is."""

from __future__ import annotations

import math
from typing import Any

REVISION = 1
"""Raised when a stored number that this module decides moves."""
MOST = 1000
"""Bounces beyond which a body counts as at rest."""


def bounced(
    gap: float, velocity: float, gravity: float, restitution: float, end: float, by_gap: Any, by_velocity: Any
) -> tuple[float, Any] | None:
    """Return the gap at the time ``end`` and its derivative by theta; None for a body that comes to rest.

    ``by_gap`` and ``by_velocity`` are the derivatives of the initial gap and velocity. A fall from gap s at velocity v
    lasts t with s + v t = g t^2 / 2 and ends at speed w = sqrt(v^2 + 2 g s): dt = (ds + t dv) / w, dw = (v dv + g ds) / w.
    """
    remaining, by_time = end, 0.0 * by_gap
    for _ in range(MOST):
        impact = math.sqrt(velocity**2 + 2 * gravity * gap)
        fall = math.inf
        if gravity > 0.0 or velocity < 0.0:
            fall = (velocity + impact) / gravity if gravity > 0.0 else -gap / velocity
        if fall > remaining:
            reached = gap + velocity * remaining - 0.5 * gravity * remaining**2
            return reached, by_gap + by_velocity * remaining - (velocity - gravity * remaining) * by_time
        if restitution * impact == 0.0:
            return None
        by_time = by_time + (by_gap + fall * by_velocity) / impact
        by_velocity = restitution * (velocity * by_velocity + gravity * by_gap) / impact
        gap, velocity, by_gap, remaining = 0.0, restitution * impact, 0.0 * by_gap, remaining - fall
    return None
