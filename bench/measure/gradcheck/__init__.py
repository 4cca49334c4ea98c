"""Gradient checks: pure functions of a cost and a gradient, independent of problems."""

from .check import AGREES, Check, Options, Part, check
from .direction import EPS, FINE, SHORT_WINDOW, WINDOW, Finding, Sample, best, diagnose, judge
from .sampling import order, points, repeats, samples
from .verdicts import BROKEN, FAULTS, MEANING, TRUSTED, UNDECIDED, UNTRUSTED, VERDICTS, most_severe

__all__ = [
    "AGREES",
    "BROKEN",
    "EPS",
    "FAULTS",
    "FINE",
    "MEANING",
    "SHORT_WINDOW",
    "TRUSTED",
    "UNDECIDED",
    "UNTRUSTED",
    "VERDICTS",
    "WINDOW",
    "Check",
    "Finding",
    "Options",
    "Part",
    "Sample",
    "best",
    "check",
    "diagnose",
    "judge",
    "most_severe",
    "order",
    "points",
    "repeats",
    "samples",
]  # fmt: skip
