"""The verdicts of a gradient check, worst first, and which of them fail the check."""

from __future__ import annotations

from collections.abc import Iterable

FAULTS = (
    "nan_gradient", "nondeterministic", "stale_gradient", "staircase", "precision", "disconnected", "wrong_factor",
    "missing_term", "wrong_adjoint",
)  # fmt: skip
"""Verdicts that the program's gradient is not the derivative of its cost."""
UNDECIDED = ("nonfinite", "unsettled")
"""Verdicts of an inconclusive check."""
BROKEN = ("jump", "missed_slope", "kink")
"""Verdicts that the cost has no derivative at this point, or under noise none that sampled gradients show."""
TRUSTED = ("saturated", "rounding", "mode_crossing", "nonlinear", "smooth", "zero")
"""Verdicts that the gradient is the derivative."""
UNTRUSTED = (*FAULTS, *UNDECIDED, *BROKEN)
"""Verdicts that end a check with exit status 1."""
VERDICTS = (*UNTRUSTED, *TRUSTED)
"""All verdicts, worst first."""
MEANING = {
    "nan_gradient": "the gradient is NaN or infinite where the cost is a number",
    "nondeterministic": "the same call returns different numbers",
    "stale_gradient": "the gradient does not change when theta does",
    "staircase": "the cost is constant between steps of its input: a cast to int, a rounding, a comparison",
    "precision": "the cost has fewer digits than its type: a cast to a shorter float",
    "disconnected": "the gradient is exactly 0 where the cost has a slope",
    "wrong_factor": "the gradient is the derivative times a constant",
    "missing_term": "the gradient has only part of the derivative",
    "wrong_adjoint": "the differences agree with each other, but not with the gradient",
    "nonfinite": "a cost is NaN or infinite",
    "unsettled": "the differences agree at no step, so the check is inconclusive",
    "jump": "the cost jumps here, so it has no derivative",
    "missed_slope": "under noise, a steep rise or a far kink carries part of the mean slope, and no sampled gradient meets it",
    "kink": "the two sides have different slopes, and a gradient can match only one",
    "saturated": "right: exactly 0, though wider differences are not: the input is clipped or has no effect here",
    "rounding": "right; small steps have larger errors than the arithmetic explains, as with a loose solver tolerance",
    "mode_crossing": "right; the two sides of wide differences have different contacts",
    "nonlinear": "right; wide differences show the curvature of the cost",
    "smooth": "right at every useful step",
    "zero": "gradient and differences are exactly zero",
}
"""The meaning of each verdict."""


def most_severe(verdicts: Iterable[str]) -> str:
    """Return the worst of the verdicts."""
    return min(verdicts, key=VERDICTS.index)
