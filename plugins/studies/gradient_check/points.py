"""The points at which gradients are checked, and the verdicts that pass at each."""

from __future__ import annotations

from bench.gradient import BROKEN, TRUSTED

POINTS = ("start", "before", "at", "after", "noise")
"""``start`` is theta0. The next three are on a line through theta0: before, at and after a switch of contact mode. ``noise``
is theta0 under noise with which the cost jumps."""


def is_trusted(point: str, verdict: str) -> bool:
    """Return whether a check passed. At a contact switch, kinks and jumps are expected."""
    return verdict in TRUSTED or (point == "at" and verdict in BROKEN)
