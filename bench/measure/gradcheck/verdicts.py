"""The names that a gradient check can give, most_severe first, and which of them nobody may build on."""

from __future__ import annotations

from collections.abc import Iterable

FAULTS = (
    "nan_gradient", "nondeterministic", "stale_gradient", "staircase", "precision", "disconnected", "wrong_factor",
    "missing_term", "wrong_adjoint",
)  # fmt: skip
"""The program's gradient is not the derivative of its cost."""
UNDECIDED = ("nonfinite", "unsettled")
"""Nothing was shown."""
BROKEN = ("jump", "kink")
"""The cost has no derivative at this point."""
TRUSTED = ("saturated", "rounding", "mode_crossing", "nonlinear", "smooth", "zero")
"""The gradient is the derivative."""
UNTRUSTED = (*FAULTS, *UNDECIDED, *BROKEN)
"""Verdicts that end a check with exit status 1."""
VERDICTS = (*UNTRUSTED, *TRUSTED)
"""All verdicts, most_severe first."""
MEANING = {
    "nan_gradient": "the gradient is NaN or infinite where the cost is a number",
    "nondeterministic": "the same call gives different numbers",
    "stale_gradient": "the gradient stays that of another theta when theta moves",
    "staircase": "the cost is constant between steps of its input: a cast to int, a rounding, a comparison",
    "precision": "the cost has fewer digits than its type: a cast to a shorter float",
    "disconnected": "the gradient is exactly 0 where the cost has a slope",
    "wrong_factor": "the gradient is the derivative times a constant",
    "missing_term": "the gradient has part of the derivative",
    "wrong_adjoint": "the differences agree with each other, on another value than the gradient",
    "nonfinite": "a cost is NaN or infinite",
    "unsettled": "the differences agree at no step, so they show nothing",
    "jump": "the cost jumps here, so it has no derivative",
    "kink": "the two sides have different slopes; a gradient can be that of only one side",
    "saturated": "right: exactly 0, and wider differences are not: the input is clipped or out of reach here",
    "rounding": "right; small steps err by more than the arithmetic explains, as with a loose solver",
    "mode_crossing": "right; the two sides of wide differences meet different contacts",
    "nonlinear": "right; wide differences see the curvature of the cost",
    "smooth": "right at every useful step",
    "zero": "gradient and differences are exactly zero",
}
"""What each verdict says."""


def most_severe(verdicts: Iterable[str]) -> str:
    """Return the worst of some verdicts."""
    return min(verdicts, key=VERDICTS.index)
