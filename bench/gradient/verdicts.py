"""The verdicts of a gradient check, worst first: what each means, and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple


class Rule(NamedTuple):
    """What a verdict says."""

    kind: str
    """``fault``: not the derivative; ``open``: not decided; ``broken``: the cost has none; ``right``; ``noise``: not usable under it."""
    meaning: str
    advice: str = ""
    """What to do next."""
    settings: tuple[str, ...] = ()
    """The settings of ``examine`` that can show more, or accept it."""


FOLLOW = "follow {names} through the cost: cut it into parts until the ratio is 1"
STEPS = ("horizons=1,2,5",)
SLOPES = (*STEPS, "refined=COST")
RULES = {
    "nan_gradient": Rule(
        "fault", "the gradient is NaN or infinite where the cost is a number",
        "where it overflows, take fewer steps or damp the rollout; else look for a division, log, sqrt or norm at the edge of "
        "its domain, or a branch that 'where' discards only in the value", STEPS,
    ),
    "nondeterministic": Rule(
        "fault", "the same call returns different numbers",
        "fix the seed, or pass the noise as w and set noise=N; reset states that persist between calls",
    ),
    "stale_gradient": Rule(
        "fault", "the gradient does not change when theta does", "look for a cache, or a copy made too early"
    ),
    "staircase": Rule(
        "fault", "the cost is constant between steps of its input: a cast to int, a rounding, a comparison",
        "estimate the gradient from costs (smoothing), or remove the rounding",
    ),
    "precision": Rule(
        "fault", "the cost has fewer digits than its type: a cast to a shorter float",
        "look for a shorter float inside, or a solver that stops early",
    ),
    "disconnected": Rule("fault", "the gradient is exactly 0 where the cost has a slope", FOLLOW, STEPS),
    "wrong_factor": Rule("fault", "the gradient is the derivative times a constant", FOLLOW, STEPS),
    "missing_term": Rule(
        "fault", "part of the derivative is right: a term is missing, detached or counted twice", FOLLOW,
        SLOPES,
    ),
    "wrong_adjoint": Rule(
        "fault", "the differences agree with each other, but not with the gradient", FOLLOW, SLOPES
    ),
    "nonfinite": Rule("open", "a cost is NaN or infinite"),
    "unsettled": Rule("open", "the differences agree at no step, so the check is inconclusive", "", ("{more}",)),
    "jump": Rule("broken", "the cost jumps here, so it has no derivative", "choose a theta beside it", ("expect={cause}",)),
    "missed_slope": Rule(
        "broken",
        "under noise, a steep rise or a far kink carries part of the mean slope, and no sampled gradient meets it",
    ),
    "kink": Rule(
        "broken", "the two sides have different slopes, and a gradient can match only one", "choose a theta beside it",
        ("expect={cause}",),
    ),
    "saturated": Rule(
        "right", "exactly 0, though wider differences are not: the input is clipped or has no effect here", "",
        ("sigma=SIGMA",),
    ),
    "rounding": Rule(
        "right", "small steps have larger errors than the arithmetic explains, as with a loose solver tolerance", "",
        ("sigma=SIGMA",),
    ),
    "mode_crossing": Rule("right", "the two sides of wide differences have different contacts", "", ("sigma=SIGMA",)),
    "nonlinear": Rule("right", "wide differences show the curvature of the cost", "", ("sigma=SIGMA",)),
    "smooth": Rule("right", "the same at every useful step", "", ("sigma=SIGMA",)),
    "zero": Rule("right", "gradient and differences are exactly zero"),
}  # fmt: skip
"""Each verdict, the worst first."""


def of_kind(kind: str) -> tuple[str, ...]:
    """Return the verdicts of a kind, worst first."""
    return tuple(name for name, rule in RULES.items() if rule.kind == kind)


FAULTS = of_kind("fault")
"""Verdicts that the program's gradient is not the derivative of its cost."""
UNDECIDED = of_kind("open")
"""Verdicts of an inconclusive check."""
BROKEN = of_kind("broken")
"""Verdicts that the cost has no derivative at this point, or under noise none that sampled gradients show."""
TRUSTED = of_kind("right")
"""Verdicts that the gradient is the derivative."""
VERDICTS = tuple(RULES)
"""All verdicts, worst first."""
MEANING = {name: rule.meaning for name, rule in RULES.items()}
"""The meaning of each verdict."""


def most_severe(verdicts: Iterable[str]) -> str:
    """Return the worst of the verdicts."""
    return min(verdicts, key=VERDICTS.index)
