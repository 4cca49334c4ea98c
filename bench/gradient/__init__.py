"""Gradient checks: pure functions of a cost and a gradient, independent of problems."""

from .check import Check, Options, Part, check, settle
from .direction import EPS, Sample, best, judge, step_sizes
from .rules import BROKEN, FAULTS, RULES, TRUSTED, UNDECIDED, VERDICTS
from .sampling import Lines, sampled

__all__ = [
    "BROKEN",
    "EPS",
    "FAULTS",
    "RULES",
    "TRUSTED",
    "UNDECIDED",
    "VERDICTS",
    "Check",
    "Lines",
    "Options",
    "Part",
    "Sample",
    "best",
    "check",
    "judge",
    "sampled",
    "settle",
    "step_sizes",
]
