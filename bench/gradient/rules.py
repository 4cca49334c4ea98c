"""All causes that an examination names: what each means, whether it decides, and what to do next."""

from __future__ import annotations

from bench.gradient import verdicts
from bench.gradient.verdicts import FOLLOW, STEPS, Rule

SMOOTHING = "estimate the gradient from costs (smoothing)"
RULES = verdicts.RULES | {
    "raised": Rule("fault", "the gradient could not be computed"),
    "rough": Rule(
        "fault", "the cost changes as much between neighbouring thetas as over a wide step",
        "look for a seed or hash taken from theta",
    ),
    "overwritten": Rule(
        "fault", "memory is overwritten between forward and backward, or a term acts only later",
        "use one tape per step, or arrays of its own for each step", STEPS,
    ),
    "no_effect": Rule(
        "broken", "an input has no effect on the cost, and is not in allow_zero",
        "check that it reaches the simulator", ("allow_zero=NAME",),
    ),
    "zero": Rule(
        "open", "no input moves the cost, and its gradient is 0, or below rounding",
        "check that theta reaches the simulator", ("allow_zero=NAME",),
    ),
    "undecided": Rule(
        "open", "the budget ended before the gradient was checked", "the rest needs more calls", ("{more}", "refined=COST")
    ),
    "unresolved": Rule(
        "open", "rounding or noise of the cost hides its slope at every step, or contradicts a small derivative"
    ),
    "adaptive": Rule(
        "open", "gradient and differences differ by as much as the discretisation does, as with adaptive steps: neither is "
        "exactly the derivative of the solution",
        "give the cost at a tighter tolerance; accept it if the gradient is meant to be that one's", ("refined=COST", "expect={cause}"),
    ),
    "jumps": Rule(
        "noise", "the gradient is right at theta, and misses jumps around it that no gradient sees", SMOOTHING
    ),
    "biased": Rule("noise", "the mean of the gradients misses a part of grad J", SMOOTHING),
    "spread": Rule(
        "open", "the gradients vary too widely to show whether their mean is grad J within 10%", SMOOTHING, ("{more}",)
    ),
    "unmeasured": Rule(
        "open", "the budget ended before the noise of sigma was measured", "the rest needs more calls", ("{more}",)
    ),
}  # fmt: skip
"""Every cause: the verdicts of the gradient check first, worst first."""
SUSPICIOUS = tuple(cause for cause, rule in RULES.items() if rule.advice == FOLLOW and cause != "disconnected")
"""Causes that adaptive steps and kinks imitate."""
EXCUSABLE = tuple(cause for cause in SUSPICIOUS if "refined=COST" in RULES[cause].settings)
"""Causes that a discretisation imitates: it makes no constant factor."""
