"""The points at which gradients are checked, and which verdicts are expected at each."""

from __future__ import annotations

from bench.measure.gradcheck import BROKEN, TRUSTED

POINTS = ("start", "before", "at", "after")
"""The first is theta0; the others are on a line through it: before, at and after a switch of contact mode."""


def is_trusted(point: str, verdict: str) -> bool:
    """Return whether a check passed. At a contact switch, kinks and jumps are expected."""
    return verdict in TRUSTED or (point == "at" and verdict in BROKEN)
