"""The order of verdicts on the derivative at theta. :data:`bench.gradient.rules.RULES` says what each means, with the numbers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from bench.gradient.rules import UNEQUAL

if TYPE_CHECKING:
    from bench.examine.findings import Findings


def in_order(f: Findings) -> Iterator[tuple[str, object, str]]:
    """Yield each verdict, whether it holds for findings, and the facts behind it: the first that holds decides."""
    # calls that fail or do not repeat
    yield "nondeterministic", f.repeats.is_failing, "equal calls raise an exception or return a number"
    yield "raised", f.is_failed, f.error_text
    yield "undecided", not f.check.parts, f.n_checked
    yield "nondeterministic", f.repeats.is_large and not f.is_noisy, f.spread_text
    yield "noisy", f.is_noisy and not f.exceeds_noise, f.noisy_text
    # a check failed: what explains it, else its own verdict
    yield f.cause_of_mean, f.is_of_a_draw, f.mean_text
    yield "staircase", f.is_suspicious and (f.is_on_tread or f.has_steps), f.failed_text
    yield "rough", f.failed == "unsettled" and f.is_rough, ""
    yield "adaptive", f.failed == "unsettled" and f.explained.wide, f.failed_text
    yield "adaptive", f.is_discretisation_gap, f.failed_text + f.loop_text
    yield "overwritten", f.failed in (*UNEQUAL, "unsettled") and f.grows, f.failed_text
    yield "continuous_adjoint", f.is_suspicious and f.is_falling, f.failed_text
    yield "undecided", f.is_suspicious and f.may_be_explained, f"{f.failed_text}: adaptive steps may explain it"
    yield "unresolved", f.is_suspicious and f.is_slight, f.failed_text
    yield f.failed, f.failed, f.failed_text
    # no check failed: what it could not show, else the verdict on a right derivative
    yield "undecided", not f.check.components or not f.is_complete, f.n_checked
    yield "nonfinite", f.is_lost_nearby, f.place
    yield "unresolved", f.gradient and f.unresolved, "".join(map(f.numbers, f.unresolved[:1]))
    yield "overwritten", f.latest and f.grows, f.late_text
    yield "missing_term", f.latest, f.late_text
    yield "constant", f.is_constant, ""
    yield "no_effect", f.has_useless_input, f.zeros_text
    yield "saturated", f.settled.cause == "zero", ""
    yield f.settled.cause, True, ""
