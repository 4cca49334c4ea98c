"""Gradient checks: pure functions of a cost and a gradient, independent of problems."""

from .check import Check, Options, Part, check, settle
from .direction import EPS, FINE, Finding, Sample, best, diagnose, judge
from .sampling import order, points, repeats, samples
from .verdicts import BROKEN, FAULTS, MEANING, TRUSTED, UNDECIDED, VERDICTS, most_severe

__all__ = [
    "BROKEN",
    "EPS",
    "FAULTS",
    "FINE",
    "MEANING",
    "TRUSTED",
    "UNDECIDED",
    "VERDICTS",
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
    "settle",
]  # fmt: skip
