"""The points at which gradients are checked, and what may be found at each."""

from __future__ import annotations

from bench.measure.gradcheck import BROKEN, TRUSTED


def trusted(point: str, verdict: str) -> bool:
    """Return whether a check leaves nothing to doubt: right on a switch of contact mode, a kink or jump is no surprise."""
    return verdict in TRUSTED or (point == "at" and verdict in BROKEN)
