"""Gradient checks: pure functions of a cost and a gradient, independent of problems."""

from .check import Check, Options, Part, check, extremes, settle
from .direction import EPS, FINE, Finding, Sample, best, judge
from .few import ROUNDS, FewSteps, is_nothing
from .rules import BROKEN, FAULTS, RULES, TRUSTED, UNDECIDED, VERDICTS, most_severe
from .sampling import order, sampled

__all__ = [
    "BROKEN",
    "EPS",
    "FAULTS",
    "FINE",
    "ROUNDS",
    "RULES",
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
