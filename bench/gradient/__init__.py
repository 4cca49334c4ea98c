"""Gradient checks: pure functions of a cost and a gradient, independent of problems."""

from .check import Check, Options, Part, check, extremes, settle
from .direction import EPS, FINE, Finding, Sample, best, judge
from .few import ROUNDS, FewSteps, is_nothing
from .sampling import order, sampled
from .verdicts import BROKEN, FAULTS, MEANING, TRUSTED, UNDECIDED, VERDICTS, most_severe

__all__ = [
    "BROKEN",
    "EPS",
    "FAULTS",
    "FINE",
    "MEANING",
    "ROUNDS",
    "TRUSTED",
    "UNDECIDED",
    "VERDICTS",
    "Check",
    "FewSteps",
    "Finding",
    "Options",
    "Part",
    "Sample",
    "best",
    "check",
    "extremes",
    "is_nothing",
    "judge",
    "most_severe",
    "order",
    "sampled",
    "settle",
]  # fmt: skip
