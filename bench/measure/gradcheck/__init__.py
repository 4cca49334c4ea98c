"""Gradient checks: pure functions of a cost and a gradient, which know nothing of problems."""

from .check import Check, Options, Part, check
from .direction import BRIEFLY, EPS, WINDOW, Finding, Sample, best, diagnose, judge
from .sampling import order, points, samples
from .verdicts import BROKEN, FAULTS, MEANING, TRUSTED, UNDECIDED, UNTRUSTED, VERDICTS, worst

__all__ = [
    "BRIEFLY", "BROKEN", "EPS", "FAULTS", "MEANING", "TRUSTED", "UNDECIDED", "UNTRUSTED", "VERDICTS", "WINDOW",
    "Check", "Finding", "Options", "Part", "Sample", "best", "check", "diagnose", "judge", "order", "points", "samples", "worst",
]  # fmt: skip
