"""The order of verdicts on the derivative at theta. :data:`bench.gradient.rules.RULES` says what each means, with the numbers."""

from __future__ import annotations

from collections.abc import Iterator

from bench.examine.facts import Facts
from bench.gradient.rules import UNEQUAL
from bench.report.text import counted, number

MANY = 8
"""Most names in a list."""


def in_order(f: Facts) -> Iterator[tuple[str, object, str]]:
    """Yield each verdict, whether it holds for some facts, and the facts behind it: the first that holds decides."""
    noise = f"{f.spread_text}; {counted(len(f.resolved_parts), 'slope')} known to 10%"
    loop = f", {f.explained.steps} has another length at other thetas" * bool(f.explained.steps)
    # calls that fail or do not repeat
    yield "nondeterministic", f.repeats.is_failing, "equal calls raise an exception or return a number"
    yield "raised", f.is_failed, f.error_text
    yield "undecided", not f.check.parts, f.n_checked
    yield "nondeterministic", f.repeats.is_large and not f.is_noisy, f.spread_text
    yield "noisy", f.is_noisy and not f.exceeds_noise, noise
    # a check failed: what explains it, else its own verdict
    yield f.cause_of_mean, f.is_of_a_draw, f.mean_text
    yield "staircase", f.is_suspicious and (f.is_on_tread or f.has_steps), f.failed_text
    yield "rough", f.failed == "unsettled" and f.is_rough, ""
    yield "adaptive", f.failed == "unsettled" and f.explained.wide, f.failed_text
    yield "adaptive", f.is_discretisation_gap, f.failed_text + loop
    yield "overwritten", f.failed in (*UNEQUAL, "unsettled") and f.grows, f.failed_text
    is_falling = f.hint and f.hint.cause == "continuous_adjoint"
    yield "continuous_adjoint", f.is_suspicious and is_falling, f.failed_text
    yield "undecided", f.is_suspicious and f.may_be_explained, f"{f.failed_text}: adaptive steps may explain it"
    yield "unresolved", f.is_suspicious and f.is_slight, f.failed_text
    yield f.failed, f.failed, f.failed_text
    # no check failed: what it could not show, else the verdict on a right derivative
    yield "undecided", not f.check.components or not f.is_complete, f.n_checked
    # no larger step is left than that with the best central difference
    yield "nonfinite", f.failures and f.failures[0][0] <= f.unit ** (1 / 3), f.place
    yield "unresolved", f.gradient and f.unresolved, "".join(map(f.numbers, f.unresolved[:1]))
    late = f.latest
    off = f"after {late.steps} steps off by {number(100 * late.error)}%" if late else ""
    yield "overwritten", late and f.grows, off
    yield "missing_term", late, off
    is_still, allowed = not f.moves_around, f.setup.allow_zero
    is_zero = is_still and all(part.verdict == "zero" for part in f.settled.parts)
    yield "constant", is_zero and (allowed is None or not allowed.all()), ""
    yield "no_effect", is_still and allowed is not None and f.zeros, ", ".join(f.zeros[:MANY])
    yield "saturated", f.settled.cause == "zero", ""
    yield f.settled.cause, True, ""
