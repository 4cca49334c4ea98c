"""The one table of rules: every verdict on a gradient, when it applies, what it means, and what to do next."""

from __future__ import annotations

from typing import NamedTuple

STATUS = {"right": 0, "fault": 1, "broken": 1, "open": 3}
"""Exit status of ``examine`` by kind. ``fault``: not the derivative; ``broken``: the cost has none, or none that sampled
gradients show under noise; ``open``: not decided. Other commands end with 1 for every kind but ``right``."""


class Rule(NamedTuple):
    """A row of the table."""

    kind: str
    """A key of :data:`STATUS`."""
    meaning: str
    condition: str
    """When it applies, with constants of the code as ``{module.NAME}``; u is the unit roundoff."""
    advice: str = ""
    """What to do next."""
    settings: tuple[str, ...] = ()
    """The settings of ``examine`` that bear on it: they can show more, or accept it."""
    is_unequal: bool = False
    """Whether the derivative is a number other than the differences."""


FOLLOW = "follow {names} through the cost: cut it into parts until the ratio is 1"
SMOOTHING = "estimate the gradient from costs (smoothing)"
STEPS, EXPECTED, MORE, SIGMA = ("horizons=1,2,5",), ("expect={cause}",), ("{more}",), ("sigma=SIGMA",)
SLOPES = (*STEPS, "refined=COST")
DERIVATIVE = {
    "nan_gradient": Rule(
        "fault",
        "the gradient is NaN or infinite where the cost is a number",
        "the costs at theta and at {direction.MIN_STEPS} step sizes or more are numbers; also under noise",
        "where it overflows, take fewer steps or damp the rollout; else look for a division, log, sqrt or norm at the edge of "
        "its domain, or a branch that 'where' discards only in the value",
        STEPS,
    ),
    "nondeterministic": Rule(
        "fault",
        "the same call returns different numbers",
        "by more than {sampling.LAST_DIGITS} u, in `examine` u^{stages.SMALL}, of the cost or the gradient's norm, or some calls raise an "
        "exception",
        "fix the seed, or pass the noise as w and set noise=N; reset states that persist between calls",
    ),
    "stale_gradient": Rule(
        "fault",
        "the gradient does not change when theta does",
        "right at theta, and wrong and equal at all others",
        "look for a cache, or a copy made too early",
    ),
    "staircase": Rule(
        "fault",
        "the cost is constant between steps of its input: a cast to int, a rounding, a comparison",
        "of {roughness.SCAN} costs in a row, {roughness.EDGES} or more isolated changes exceed all others {roughness.APART:g} times "
        "and make up {check.SHARE:.0%} of the gradient's error, and the gradient is not the slope over them. Around theta: lines are flat between jumps, or the gradient misses "
        "{facts.SEEN:.0%} of the cost's change in jumps of one height at even distances; or the differences at the "
        "{direction.MIN_STEPS} smallest steps are 0 beside jumps, and wider ones are not, or the gradient is below {facts.RESIDUE:g} of a jump",
        f"{SMOOTHING}, or remove the rounding",
    ),
    "precision": Rule(
        "fault",
        "the cost has fewer digits than its type: a cast to a shorter float",
        "the steps of `staircase`, and the gradient is the slope over them",
        "look for a shorter float inside, or a solver that stops early",
    ),
    "disconnected": Rule(
        "fault",
        "the gradient is exactly 0 where the cost has a slope",
        "as `wrong_adjoint`",
        FOLLOW,
        STEPS,
        True,
    ),
    "wrong_factor": Rule(
        "fault",
        "the gradient is the derivative times a constant",
        "`wrong_adjoint`, and {causes.MOSTLY:.0%} of {causes.ENOUGH} or more ratios at several thetas are equal "
        "within their errors and {causes.CONSTANT:.1%}",
        FOLLOW,
        STEPS,
        True,
    ),
    "missing_term": Rule(
        "fault",
        "part of the derivative is right: a term is missing, detached or counted twice",
        "`wrong_adjoint` with unequal ratios, where other components or thetas are right, or {causes.MOSTLY:.0%} of the ratios "
        "lie between 0 and 2; or wrong at some of `horizons`",
        FOLLOW,
        SLOPES,
        True,
    ),
    "wrong_adjoint": Rule(
        "fault",
        "the differences agree with each other, but not with the gradient",
        "off by more than the error of the best difference: {direction.CHANCE:g} times its distance from its neighbours, rounding, and "
        "u^(1/3) of its size, in float32 {direction.LARGEST:.1%}; after one to three step sizes, by {few.CLEAR:g} times the error",
        FOLLOW,
        SLOPES,
        True,
    ),
    "nonfinite": Rule(
        "open",
        "a cost is not a number, or raises an exception",
        "at theta, or a number at fewer than {direction.MIN_STEPS} step sizes, or under noise; in `examine` also within u^(1/3) of theta",
    ),
    "unsettled": Rule(
        "open",
        "the differences agree at no step, so the check is inconclusive",
        "the error of the best is above {direction.ALIKE:.0%} of it, or smaller steps contradict it",
        "",
        MORE,
    ),
    "coarse": Rule(
        "open",
        "right of the cost's smooth part to the accuracy that its roughness allows, which is less than the tolerance",
        "`adaptive` steps or a solver that stops early: scatter around quadratics does not fall with the scale. In `examine`: the gradient "
        "is within the error of the slope over wide steps, which is above `tolerance`",
        "give the cost a tighter tolerance",
        ("refined=COST", *MORE),
    ),
    "jump": Rule(
        "broken",
        "the cost jumps here, so it has no derivative",
        "the two sides differ by a constant at the {direction.SHORT_WINDOW} smallest steps, extrapolated to 0. Under noise in `gradcheck`: a "
        "change within {jumps.REACH:g} sigma that does not shrink down to {jumps.FINEST:g} of its line",
        "choose a theta beside it",
        EXPECTED,
    ),
    "missed_slope": Rule(
        "broken",
        "under noise, a steep rise or a far kink carries part of the mean slope, and no sampled gradient meets it",
        "in `gradcheck`: gradients within {jumps.MET:g} sigma miss {jumps.MISSED:.0%} of the largest mean slope of a line",
    ),
    "kink": Rule(
        "broken",
        "the two sides have different slopes, and a gradient can match only one",
        "by a constant over {direction.DECADES:g} decades of steps, and the derivative is between them",
        "choose a theta beside it",
        EXPECTED,
    ),
    "smooth_part": Rule(
        "right",
        "the derivative of the cost's smooth part: at tiny steps the cost has that of one sequence of steps",
        "as `coarse`, and the error is within `tolerance`, or that of the refined cost",
        "",
        SIGMA,
    ),
    "saturated": Rule(
        "right",
        "exactly 0, though wider differences are not: the input is clipped or has no effect here",
        "as the differences at the {direction.MIN_STEPS} smallest steps; or `zero` for all, where jumps or noise around theta move the cost",
        "",
        SIGMA,
    ),
    "rounding": Rule(
        "right",
        "small steps have larger errors than the arithmetic explains, as with a loose solver tolerance or a gradient that is a long difference",
        "three smaller steps have errors above {direction.NOISY:g} times rounding, or the derivative is off by less than "
        "{check.LOOSE:.1%} of the largest and {check.EXPLAINED:g} times the jumps of a solver that stops early",
        "",
        SIGMA,
    ),
    "mode_crossing": Rule(
        "right",
        "the two sides of wide differences have different contacts",
        "a wider difference is off by {direction.RISE:.0%}",
        "",
        SIGMA,
    ),
    "nonlinear": Rule(
        "right",
        "wide differences show the curvature of the cost",
        "a wider difference is off by {direction.RISE:.0%}, or the derivative by no more than `tolerance`",
        "",
        SIGMA,
    ),
    "smooth": Rule(
        "right",
        "the same at every useful step",
        "within the error of differences that agree within {direction.ALIKE:.0%}",
        "",
        SIGMA,
    ),
    "zero": Rule(
        "right",
        "gradient and differences are exactly zero",
        "the cost moves at no step, and the derivative is 0, or moves it by less than {few.ROUNDED:g} u over the input's scale",
    ),
}
"""Verdicts on one derivative, in every check, worst first."""
EXAMINATION = {
    "raised": Rule(
        "fault",
        "the gradient could not be computed",
        "an exception at theta",
    ),
    "rough": Rule(
        "fault",
        "the cost changes as much between neighbouring thetas as over a wide step",
        "`unsettled`, and neighbours by {judged.ROUGH:.0%} of the largest change, which the gradient does not explain",
        "look for a seed or hash taken from theta",
    ),
    "overwritten": Rule(
        "fault",
        "memory is overwritten between forward and backward, or a term acts only later",
        "with `horizons` right at the first, and {diagnosis.GROWTH:g} times as wrong at the last as at the first wrong one",
        "use one tape per step, or arrays of its own for each step",
        STEPS,
    ),
    "continuous_adjoint": Rule(
        "fault",
        "an adjoint that is solved on its own: its error falls with the number of steps",
        "`missing_term` or `wrong_adjoint`, and with `horizons` the error falls at each, {hints.FALLS:g} times in all",
        "differentiate through the solver, or tighten the tolerances of both",
        ("refined=COST",),
    ),
    "estimator": Rule(
        "right",
        "not the derivative of each draw of the cost's noise, but its mean is that of the mean cost",
        "with `noise`, wrong at a fixed draw, and the error of the mean and twice its standard error are together below {means.RIGHT:.0%}; "
        "where jumps may carry {means.ALIKE:.0%} of the mean slope, the bias under noise on theta is. Where the mean is off, and the gradient is "
        "a multiple of each draw's slope to {means.SAME:.0%}, the verdict is that of a draw",
    ),
    "no_effect": Rule(
        "broken",
        "an input has no effect on the cost, and is not in allow_zero",
        "`zero` where `allow_zero` is given, without jumps or a slope under noise around theta",
        "check that it reaches the simulator",
        ("allow_zero=NAME",),
    ),
    "noisy": Rule(
        "open",
        "the cost draws noise of its own, which hides the slope",
        "the spread of equal calls of the cost is above u^{stages.SMALL} of it, or a call in a check of a derivative does not repeat; it does not come from the call before, in {stages.CALLS_OF_STATE} calls; and nothing else is wrong or, where the gradient has "
        "noise too or a derivative did not repeat, no difference is {facts.CONTRADICTED:g} errors, with those by noise, away from it",
        "fix the seed, or pass the noise as w and set noise=N",
        EXPECTED,
    ),
    "constant": Rule(
        "open",
        "no input moves the cost, and its gradient is 0, or below rounding",
        "`zero` for every checked input, without jumps or a slope under noise around theta, unless `allow_zero` has all",
        "check that theta reaches the simulator",
        ("allow_zero=NAME",),
    ),
    "undecided": Rule(
        "open",
        "the budget ended before the gradient was checked",
        "an input is unchecked, or wrong by less than {diagnosis.NEAR:.0%} and no search for adaptive steps was possible",
        "the rest needs more calls",
        (*MORE, "refined=COST"),
    ),
    "unresolved": Rule(
        "open",
        "rounding or noise of the cost hides its slope at every step, or contradicts a small derivative",
        "right, but the error of the difference is above {facts.RESOLVED:.0%} of it, of derivatives that matter, or above {facts.DIGIT:.0%}, of inputs below {facts.TINY:g}; or both are {facts.CONTRADICTED:g} errors and "
        "{facts.DIGIT:.0%} apart; or not 0 and below {facts.PART:.0%} of a difference that is below about {facts.SLIGHT:g} of the largest right derivative",
    ),
    "adaptive": Rule(
        "open",
        "gradient and differences differ by as much as the discretisation does, as with adaptive steps: neither is "
        "exactly the derivative of the solution",
        "`missing_term` or `wrong_adjoint` where a loop's length depends on theta, and the error is at most {diagnosis.EXPLAINED:g} times "
        "the slope of jumps, over the length of a line, and kinks; or {diagnosis.EXPLAINED_IF_SMALL:g} times, or there are fewer than "
        "{diagnosis.FEWEST_BREAKS} breaks, where it and that of each wrong component are at most {diagnosis.NEAR:.0%}; jumps above {diagnosis.MOST_OF_CHANGE:.0%} of the cost's change on their line are events and do not count. With `refined`: the gradient is at "
        "most {judged.AGREES:g} times as far from it as the differences at each theta, or {facts.AS_FAR:g} times beside such a loop. "
        "Of a rough cost: no slope over wide steps is known to {smooth_part.LIMIT:.0%}",
        "give the cost at a tighter tolerance; accept it if the gradient is meant to be that one's",
        ("refined=COST", *EXPECTED),
    ),
}
"""Verdicts from all facts that ``examine`` has at theta, in the order of :mod:`bench.examine.verdicts`, instead of the worst on a derivative."""
NOISE = {
    "jumps": Rule(
        "broken",
        "the gradient is right at theta, and misses jumps around it that no gradient sees",
        "its integral misses {smoothing.TARGET_ERROR:.0%} of the cost's change along a line, and no bias was measured",
        SMOOTHING,
        EXPECTED,
    ),
    "biased": Rule(
        "broken",
        "the mean of the gradients misses a part of grad J",
        "the 95% interval of the bias is above {smoothing.TARGET_ERROR:.0%} of grad J",
        SMOOTHING,
    ),
    "spread": Rule(
        "open",
        "the gradients vary too widely to show whether their mean is grad J",
        "that interval contains {smoothing.TARGET_ERROR:.0%}, or grad J is less than {smoothing.CLEAR:g} times its error; or a line of `jumps` has none",
        "",
        MORE,
    ),
    "unmeasured": Rule(
        "open",
        "the budget ended before the noise of sigma was measured",
        "fewer than {smoothing.FEWEST} pairs of costs at a sigma",
        "the rest needs more calls",
        MORE,
    ),
}
"""Verdicts of ``examine`` on what is around theta, or under noise."""
RULES = DERIVATIVE | EXAMINATION | NOISE
"""Every verdict."""


def of_kind(kind: str) -> tuple[str, ...]:
    """Return the verdicts of a kind on one derivative, worst first."""
    return tuple(name for name, rule in DERIVATIVE.items() if rule.kind == kind)


FAULTS = of_kind("fault")
"""Verdicts that the program's gradient is not the derivative of its cost."""
UNDECIDED = of_kind("open")
"""Verdicts of an inconclusive check."""
BROKEN = of_kind("broken")
"""Verdicts that the cost has no derivative at this point, or under noise none that sampled gradients show."""
TRUSTED = of_kind("right")
"""Verdicts that the gradient is the derivative."""
VERDICTS = tuple(DERIVATIVE)
"""All verdicts on one derivative, worst first."""
UNEQUAL = tuple(name for name, rule in DERIVATIVE.items() if rule.is_unequal)
"""Verdicts on a derivative that is a number other than the differences."""
SUSPICIOUS = tuple(name for name in UNEQUAL if name != "disconnected")
"""Causes that adaptive steps and kinks imitate."""
EXCUSABLE = tuple(name for name in SUSPICIOUS if "refined=COST" in RULES[name].settings)
"""Causes that a discretisation imitates: it makes no constant factor."""
