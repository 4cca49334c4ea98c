"""The findings of an examination: verdicts, text and tables."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from bench.examine.diagnosis import Gap, Horizon, grows, may_be_adaptive
from bench.examine.gradient import SUSPICIOUS, recaused
from bench.examine.lines import ALIKE, LineScan
from bench.examine.smoothing import PAIRS, TARGET_ERROR, Method, Smoothed
from bench.measure.gradcheck import FAULTS, MEANING, TRUSTED, VERDICTS, Check, Part, Sample
from bench.model.simulator.simulator import Printed
from bench.report.text import counted, duration, number, span

if TYPE_CHECKING:
    import pandas as pd

EXPLANATIONS = MEANING | {
    "nondeterministic": "the same call returns different numbers: new noise in every call, or state that persists between calls; "
    "pass the noise as w, or fix its seed",
    "stale_gradient": "the gradient does not change when theta does: a cache that is never cleared, or a copy made too early",
    "staircase": "the cost is constant between steps: a cast to int, rounding, or a comparison inside",
    "precision": "the cost has fewer digits than its type: a shorter float inside, or a solver that stops early",
    "disconnected": "the gradient is exactly 0 where the cost has a slope: detached, or an operation that cuts gradients",
    "wrong_factor": "a factor or a sign is wrong",
    "missing_term": "part of the derivative is right: a term is missing, detached or counted twice",
    "nonfinite": "the cost is not a number at theta or near it",
    "unsettled": "the differences agree at no step, so the check is inconclusive: the cost is chaotic, or too noisy at every step",
    "unresolved": "the cost's rounding or noise hides its slope at every step, so the check can show neither a right nor a wrong value",
    "jump": "the cost jumps at theta, so it has no derivative",
    "kink": "theta is on a kink, with two slopes and no derivative",
    "saturated": "the gradient is right and exactly 0, though wider steps show a slope: the input is clipped, or has no effect here",
    "zero": "the gradient and all differences are 0, or below the cost's rounding: does this input have any effect?",
    "raised": "the gradient could not be computed",
    "undecided": "the budget ended before the gradient was checked",
    "rough": "the cost changes as much between neighbouring thetas as over a wide step: a seed or hash taken from theta, or chaos",
    "adaptive": "gradient and differences differ by as much as the discretisation does, as with adaptive steps or meshes: the gradient "
    "holds the steps fixed, the differences do not, and neither is exactly the derivative of the solution",
    "overwritten": "memory overwritten between forward and backward, such as arrays shared by all steps of one tape, or a term that "
    "acts only later",
    "twin": "the two costs that must agree differ",
    "no_effect": "an input has no effect on the cost and is not in allow_zero: does it reach the simulator?",
    "jumps": "the gradient is right at theta, and misses jumps around it that no gradient sees",
    "biased": "each gradient is right, and their mean misses jumps",
    "spread": "the gradients vary too widely to show whether their mean is grad J within 10%",
    "unmeasured": "the budget ended before the noise of sigma was measured",
}
"""The meaning of each cause for the simulator's author, with likely reasons."""
CAUSES = (*VERDICTS, *(cause for cause in EXPLANATIONS if cause not in VERDICTS))
"""All causes."""
SEEN = 0.01
"""Share of a cost's change along a line that the integral of the gradient may miss without a warning."""
NOTEWORTHY = ("zero", "saturated")
"""Verdicts of right gradients that deserve a warning."""
NOT_SHOWN = ("undecided", "unsettled", "unresolved", "nonfinite", "adaptive", "zero", "spread", "unmeasured")
"""Causes that decide neither for nor against a gradient: exit status 3."""
DIGIT = 0.1
"""Largest uncertainty of a difference that shows a derivative, relative to the derivative or to slopes nearby."""
CONTRADICTED = 10.0
"""Uncertainties of a difference from which a derivative is not called right, even if it is small beside the others."""
DEVIATIONS = 4.0
"""Standard deviations of the slope along a random direction that errors within the tolerance do not exceed."""
SEEN_ALONE = 4.0
"""Multiple of a slope's error from which the error of one number shows along most random directions."""
DIFFERENT = 1e-6
"""Relative difference of two costs that must agree, in double precision."""
AGREES = 0.5
"""Largest distance of a gradient that agrees with a refined cost, relative to that of the cost's own differences."""
AS_FAR = 4.0
"""Largest such distance over all thetas together where the steps depend on theta, so that the gradient has its own error."""
EXCUSABLE = ("missing_term", "wrong_adjoint")
"""Causes that a discretisation imitates: it makes no constant factor."""
OPEN_TO_EXPECT = ("jump", "kink", "undecided", "unsettled", "unresolved", "nonfinite", "adaptive", "zero", "no_effect")
"""Causes at theta that ``expect`` may accept; a wrong gradient stays wrong."""
CLEAR_ORDER = 1.5
"""Order of a Taylor remainder below which it shows a wrong gradient."""
LATE = 1.2
"""Ratio of the time on the clock to the charged time from which on both are stated."""
SAME_FACTOR = 0.05
"""Largest relative range of ratios that are stated as one factor."""
OVERFLOWS = 1e100
"""Size of a derivative from which on one that is not a number is an overflow."""
ALONG_THETA = 0.9999
"""Least cosine between theta and an error along theta."""
RESIDUE = 1e-4
"""Largest change of the cost by a gradient, relative to the height of a jump, that is a residue of a solver."""
SHOWN = 8
"""Most numbers of theta in the table of breaks."""
HEADLINE = 200
"""Most characters of an exception in a headline."""
RIGHT, WRONG, UNSHOWN, NONE = "right", "wrong", "not shown", "none given"
"""Answers about the derivative."""


def _is_resolved(part: Part) -> bool:
    """Return whether a part's difference has at least one correct digit."""
    return part.uncertainty < DIGIT * abs(part.difference)


@np.errstate(all="ignore")
def _slope_nearby(sample: Sample) -> float:
    """Return the largest one-sided slope of a sample that exceeds its noise, less the noise."""
    slopes = np.maximum(np.abs(sample.left), np.abs(sample.right)) - 3.0 * sample.uncertainty
    return float(np.nanmax(np.where(np.isfinite(slopes), slopes, 0.0), initial=0.0))


@dataclass(frozen=True)
class GroupSize:
    """What errors of a group's numbers do to the slope along its random direction, in units of their scales."""

    count: int
    """Number of numbers n."""
    allowed: float
    """Norm of the tolerated errors of the numbers."""
    slope: float
    """Norm of the gradient of the numbers."""

    @property
    def tolerated(self) -> float:
        """Largest error of the slope from errors of its numbers that are all within their tolerance.

        The direction is random and of length 1, so the slope's error has a standard deviation of ``allowed / sqrt(n)``.
        """
        return min(DEVIATIONS / math.sqrt(self.count), 1.0) * self.allowed

    def hidden(self, error: float) -> float:
        """Return the error of one number that a slope with ``error`` may hide, relative to the numbers' root mean square."""
        return SEEN_ALONE * error * self.count / self.slope if self.slope > 0 else math.inf


@dataclass(frozen=True)
class Findings:
    """The findings about a cost and its gradient at one theta; ``print`` shows them as text."""

    name: str
    """Name of the cost."""
    gradient: str
    """Source of the gradient: ``jax``, ``torch``, a function's name, or empty for differences only."""
    names: Sequence[str]
    """A name for each of theta's d numbers."""
    theta: np.ndarray
    """``(d,)``."""
    cost: float
    precision: str
    is_hidden_single: bool
    """Whether the cost returns float64 numbers with single precision."""
    spread: float
    """Largest difference between equal calls of the cost."""
    gradient_spread: float
    """Largest difference between equal calls of the gradient, relative to its norm."""
    is_small_spread: bool
    """Whether these differences only limit the accuracy of the check."""
    has_state: bool
    """Whether the cost depends on the call before it."""
    batch: str
    costs: int
    """Number of costs computed, one per theta."""
    gradients: int
    """Number of gradients computed, one per theta."""
    seconds: float
    """Time within the budget [s]."""
    compile_s: float
    """Time of first calls [s]."""
    elapsed: float
    """Time on the clock, including first calls and waiting for a processor that other programs use [s]."""
    budget: float
    calls: float
    """Limit of costs and gradients together."""
    cost_s: float
    """Time of one cost [s]."""
    gradient_s: float
    """Time of one gradient [s]; NaN without a gradient."""
    check: Check | None
    """The gradient check; None if it did not finish within the budget."""
    is_quick: bool
    """Whether the check has at most three steps per component."""
    is_complete: bool
    """Whether every chosen component and group was checked."""
    located: dict[str, str]
    """By name of a wrong group: the numbers that cause its error."""
    groups: dict[str, GroupSize]
    """By name of a group of numbers that move along one random direction: its size."""
    more: Sequence[Check]
    """Checks under further draws of the simulator's own noise."""
    rtol: np.ndarray
    """Tolerated relative error of each derivative, ``(d,)``."""
    atol: np.ndarray
    """Tolerated absolute error of each derivative, ``(d,)``."""
    allow_zero: np.ndarray | None
    """Whether each input may have no effect; None: a warning."""
    expect: str
    """The known cause with which the report passes."""
    lines: Sequence[LineScan]
    reach: float
    """One standard deviation on the lines: a sigma of theta, or a share of the scale of each input."""
    relative: bool
    """Whether sigma is relative to the scale of each input, as it is by default."""
    requested: Sequence[float]
    """The given values of sigma."""
    smoothed: Sequence[Smoothed]
    error: str
    """The exception that the gradient at theta raised; empty if none."""
    elsewhere: str
    """The exception that the gradient raised at another theta; empty if none."""
    n_failed: int
    """Number of gradient calls that raised an exception."""
    is_adaptive: bool
    """Whether steps that depend on theta explain the error of the gradient, by the jumps of the cost."""
    steps: str
    """The place of a loop whose length depends on theta, as ``ode.py:17``; empty where none is known."""
    is_unexplained: bool
    """Whether the error is so small that adaptive steps may explain it, and the budget ended before that was known."""
    printed: Printed
    notes: Sequence[str]
    left_out: Sequence[str]
    """The parts of the examination that the budget did not allow."""
    twin: float | None = None
    """Largest relative difference between the cost and its twin."""
    twin_error: tuple[float, float] | None = None
    """Relative errors of the gradient and of the second gradient."""
    refined: Check | None = None
    """The gradient against differences of a refined cost."""
    gaps: Sequence[Gap] = ()
    """At theta and at others: how far gradient and cost are from the refined cost; empty without a refined cost."""
    growth: Sequence[Horizon] = ()
    """The error of the gradient by number of steps."""
    command: str = ""
    """The command line of this report, or empty."""
    changes: Sequence[str] = ()
    """Differences from the baseline."""
    is_as_before: bool = False
    """Whether there is a baseline and nothing is worse."""

    # -------------------------------------------------------------------------------------------- verdicts

    @property
    def repeats(self) -> bool:
        """Whether equal calls return equal costs."""
        return self.spread == 0.0

    @cached_property
    def settled(self) -> Check | None:
        """The check with tolerated errors counted as right."""
        if self.check is None or self.check.cause not in (*SUSPICIOUS, "disconnected"):
            return self.check
        return recaused(self.check, lambda part: replace(part, verdict="nonlinear") if self._is_small(part) else part)

    @np.errstate(all="ignore")
    def _is_small(self, part: Part) -> bool:
        """Return whether a wrong part's error is within the tolerance."""
        assert self.check is not None
        if part.verdict not in (*SUSPICIOUS, "disconnected"):
            return False
        if part.component is not None:
            rtol, atol = self.rtol[part.component], self.atol[part.component]
            allowed = atol + rtol * abs(part.difference)
        elif part.name in self.groups:
            allowed = self.groups[part.name].tolerated
        else:  # along a direction of length 1 in units of the scales
            sizes = [p.difference * p.sample.scale for p in self.check.components]
            along = max(float(np.linalg.norm(np.nan_to_num(sizes))), abs(part.difference))
            parts = [p.sample.scale * self.atol[p.component] for p in self.check.components if p.component is not None]
            parts += [group.allowed for group in self.groups.values()] if self.atol.any() else []
            absolute = GroupSize(max(len(parts), 1), float(np.linalg.norm(parts)), 0.0).tolerated
            allowed = float(self.rtol.max()) * along + absolute
        return bool(abs(part.program - part.difference) <= allowed)

    @property
    def small_errors(self) -> list[Part]:
        """The components with an error within the tolerance, the largest first."""
        if self.check is None or self.settled is self.check:
            return []
        parts = [part for part in self.check.parts if self._is_small(part)]
        return sorted(parts, key=lambda part: -part.error)

    @cached_property
    def unresolved(self) -> list[Part]:
        """The components that the check accepts, though differences cannot see them or contradict them.

        A component is seen if its difference has one correct digit, compared with the derivative or with the slopes of
        wider steps, which are not 0 at a minimum. Unseen components that are small beside the seen ones do not count.
        """
        parts = (
            []
            if self.settled is None
            else [p for p in self.settled.components if p.verdict in TRUSTED and p.verdict != "zero"]
        )
        seen = [p for p in parts if p.uncertainty < DIGIT * max(abs(p.difference), _slope_nearby(p.sample))]
        largest = max((abs(p.difference) * p.sample.scale for p in seen), default=0.0)
        hidden = [p for p in parts if p not in seen and abs(p.program) * p.sample.scale > DIGIT * largest]
        contradicted = [
            p
            for p in seen
            if abs(p.program - p.difference)
            > max(CONTRADICTED * p.uncertainty, DIGIT * max(abs(p.difference), abs(p.program)))
            and _is_resolved(p)
            and not self._is_small(replace(p, verdict="wrong_adjoint"))
        ]
        return hidden + contradicted

    @property
    def hidden(self) -> float:
        """Relative error of one typical number that the check of its group may not show; 0 without groups."""
        parts = [] if self.check is None else [part for part in self.check.parts if part.name in self.groups]
        errors = [
            self.groups[part.name].hidden(
                max(abs(part.program - part.difference), CONTRADICTED * part.uncertainty + part.sample.doubt)
            )
            for part in parts
            if part.verdict in TRUSTED or self._is_small(part)
        ]
        return max((error for error in errors if math.isfinite(error)), default=0.0)

    @property
    def zeros(self) -> list[str]:
        """The inputs without any effect that ``allow_zero`` does not name."""
        if self.check is None:
            return []
        parts = [part for part in self.check.components if part.verdict == "zero"]
        return [
            self.label(part)
            for part in parts
            if self.allow_zero is None or part.component is None or not self.allow_zero[part.component]
        ]

    @property
    def wrong_checks(self) -> list[Check]:
        """The failed checks: at theta, and under other noise."""
        checks = [self.settled, *self.more]
        return [one for one in checks if one is not None and not one.trusted]

    @cached_property
    def derivative_cause(self) -> str:
        """The cause of the first problem with the derivative at theta, or the verdict on a right one."""
        check = self.settled
        if self.error:
            return "raised"
        if check is None:
            return "undecided"
        if self.twin is not None and self.twin > max(DIFFERENT, self._unit ** (2 / 3)):
            return "twin"
        if not self.is_small_spread and (self.spread > 0 or self.gradient_spread > 0 or self.has_state):
            return "nondeterministic"
        if self.wrong_checks:
            cause = self.wrong_checks[0].cause
            if cause in SUSPICIOUS and self._is_residue:
                return "staircase"
            if cause in EXCUSABLE and self.is_discretisation_gap:
                return "adaptive"
            if cause in (*SUSPICIOUS, "unsettled", "disconnected") and self.is_overwritten:
                return "overwritten"
            return "undecided" if cause in SUSPICIOUS and self.is_unexplained and self.refined is None else cause
        if not check.components or not self.is_complete:
            return "undecided"
        if self.gradient and self.unresolved:
            return "unresolved"
        is_allowed = self.allow_zero is not None and bool(self.allow_zero.all())
        if all(part.verdict == "zero" for part in check.parts) and not is_allowed and not self.moves_around:
            return "zero"
        if self.allow_zero is not None and self.zeros and not self.moves_around:
            return "no_effect"
        return "saturated" if check.cause == "zero" else check.cause

    @property
    def _is_residue(self) -> bool:
        """Whether the gradient is a residue beside the jumps of a cost that is constant around theta."""
        assert self.check is not None
        wrong = [part for part in self.check.parts if part.verdict in SUSPICIOUS]
        height = max((jump.size for line in self.lines for jump in line.jumps), default=0.0)
        return bool(wrong) and all(
            not part.sample.differences.any() and abs(part.program) * part.sample.scale <= RESIDUE * height
            for part in wrong
        )

    @property
    def is_discretisation_gap(self) -> bool:
        """Whether evidence of its own says that the gradient is that of another discretisation of the same problem.

        Either the gradient agrees with a refined cost where the cost's own differences do not, at every theta compared. Or
        the steps depend on theta, and the error is of the size of the jumps that this makes, or of a refined cost's gap.
        """
        if not self.gaps:
            return bool(self.steps) and self.is_adaptive
        if all(gap.gradient <= AGREES * gap.own for gap in self.gaps):
            return True
        gradient, own = (
            float(np.linalg.norm(sizes)) for sizes in zip(*((g.gradient, g.own) for g in self.gaps), strict=True)
        )
        return bool(self.steps) and gradient <= AS_FAR * own

    @property
    def is_overwritten(self) -> bool:
        """Whether another gradient is right where this one is wrong, or its error grows with the number of steps."""
        if self.twin_error is not None:
            own, other = self.twin_error
            return other <= max(float(self.rtol.max()), 0.01 * own)
        return grows(self.growth, max(float(self.rtol.max()), 1e-3))

    @property
    def derivative(self) -> str:
        """The answer about the derivative at theta: ``right``, ``wrong``, ``not shown`` or ``none given``."""
        cause = self.derivative_cause
        if cause in NOT_SHOWN:
            return UNSHOWN
        if cause in TRUSTED:
            return RIGHT if self.gradient else NONE
        return WRONG

    @cached_property
    def noise_cause(self) -> str:
        """The cause of the first problem around theta or under noise, from costs and gradients there; empty if there is none."""
        if self.has_steps and (self.derivative in (RIGHT, NONE) or not self.is_measured):
            return "staircase"
        if self._misses_jumps:
            return "staircase" if self.tread else "jumps"
        for cause, is_found in (
            ("nonfinite", [not one.defined for one in self.smoothed]),
            ("biased", [one.biased for one in self.smoothed]),
            ("spread", [one.unshown or one.hidden for one in self.smoothed]),
        ):
            if any(is_found):
                return cause
        return "unmeasured" if self.gradient and len(self.smoothed) < len(self.requested) else ""

    @property
    def is_measured(self) -> bool:
        """Whether the bias of the mean gradient is decided at every sigma."""
        return len(self.smoothed) >= max(len(self.requested), 1) and all(
            one.known and one.decided and math.isfinite(one.bias) for one in self.smoothed
        )

    @property
    def _misses_jumps(self) -> bool:
        """Whether a line shows jumps that bias the gradient, and no measured bias says more."""
        # a part of the cost that is rounded everywhere is a fault of its own, however small
        return self.missed > (SEEN if self.tread else TARGET_ERROR) and not self.is_measured

    @property
    def cause(self) -> str:
        """The cause of the first problem, that of theta before noise, or the verdict on a right gradient: one of :data:`CAUSES`."""
        if self.derivative in (WRONG, UNSHOWN):
            return self.derivative_cause
        return self.noise_cause or self.derivative_cause

    @property
    def status(self) -> int:
        """The exit status: 0 right, 1 wrong, 3 not decided; 0 also for the expected cause, and as in the baseline."""
        if self.is_as_before or self.is_expected:
            return 0
        if self.derivative == WRONG:
            return 1
        if self.derivative == UNSHOWN:
            return 3
        return 0 if not self.noise_cause else 3 if self.noise_cause in NOT_SHOWN else 1

    @property
    def is_expected(self) -> bool:
        """Whether the cause is the expected one, and no wrong gradient."""
        if not self.expect or self.expect != self.cause:
            return False
        return self.cause in OPEN_TO_EXPECT or self.derivative in (RIGHT, NONE)

    @property
    def size(self) -> float:
        """Largest relative error of a checked derivative, NaN if unknown."""
        if self.check is None or not self.gradient:
            return math.nan
        parts = [part for part in self.check.worst_parts if part.component is not None] or list(self.check.worst_parts)
        parts = parts if self.check.cause in FAULTS else list(self.check.components)
        return max((part.error for part in parts if math.isfinite(part.error)), default=math.nan)

    @property
    def problems(self) -> list[str]:
        """The problems as sentences, worst first; empty if there are none."""
        problems = []
        if self.derivative in (WRONG, UNSHOWN):
            problems.append(self._derivative_problem())
            if self.derivative_cause in ("nondeterministic", "twin") and self.wrong_checks:
                problems += [
                    self.sentence(one) for one in self.wrong_checks[:1] if one.cause in (*SUSPICIOUS, "disconnected")
                ]
        elif self.noise_cause:
            problems += self._noise_problems()
        return problems

    def _derivative_problem(self) -> str:
        cause = self.derivative_cause
        text = f"{cause}: {EXPLANATIONS[cause]}"
        if cause == "raised":
            return f"{text}: {shortened(self.error)}"
        if cause == "twin":
            return f"{text} by {number(100 * (self.twin or 0.0))}% at theta or near it"
        if cause == "nondeterministic":
            if self.has_state:
                text = (
                    f"{cause}: the cost depends on the call before it: a warm start, a cache or a count that persists"
                )
            if self.spread > 0:
                return f"{text} (costs differ by {number(self.spread)}{self._relative(self.spread)})"
            if self.gradient_spread > 0:
                return f"{text} (gradients differ by {number(100 * self.gradient_spread)}%)"
            return text
        if cause == "adaptive":
            loop = f"; the loop at {self.steps} has another length at other thetas" if self.steps else ""
            return f"{text} ({self._worst_size(self.wrong_checks[0])}{loop}{self._refined_text()})"
        if cause == "overwritten":
            return f"{text}{self._overwritten_text()} ({self._worst_size(self.wrong_checks[0])})"
        if cause == "zero":
            return "zero: no input moves the cost, and its gradient is 0, or below rounding: does theta reach the simulator?"
        if cause == "no_effect":
            return f"{text} ({', '.join(self.zeros[:6])})"
        if cause == "unresolved":
            part = self.unresolved[0]
            numbers = f"program {_as_text(part.program)}, differences {_as_text(part.difference)} +- {number(part.uncertainty, 1)}"
            return f"{text} ({self.label(part)}: {numbers})"
        if cause == "rough":
            return f"{text} (by {number(self.settled.noise if self.settled else math.nan)})"
        if cause == "undecided" and self.wrong_checks:
            small = "the gradient is off by so little that adaptive steps may explain it, and the budget ended before that was known"
            return f"{cause}: {small} ({self._worst_size(self.wrong_checks[0])})"
        if cause == "undecided":
            return f"{text}: {self._n_checked()}"
        return self.sentence(self.wrong_checks[0])

    def _relative(self, spread: float) -> str:
        size = abs(self.cost)
        return f", {number(100 * spread / size)}% of the cost" if size > 0 and math.isfinite(size) else ""

    def _refined_text(self) -> str:
        if self.refined is None:
            return ""
        errors = [part.error for part in self.refined.components if math.isfinite(part.error)]
        return f"; from the refined cost {number(100 * max(errors, default=math.nan))}%"

    def _overwritten_text(self) -> str:
        if self.twin_error is not None:
            own, other = self.twin_error
            return f"; the second gradient is right to {number(100 * other)}%, this one is off by {number(100 * own)}%"
        return "; right after few steps and wrong after many, off by " + ", ".join(
            f"{number(100 * one.error)}% after {one.steps} steps" for one in self.growth
        )

    def _noise_problems(self) -> list[str]:
        problems = []
        if self.has_steps:
            problems.append(
                "staircase: the cost is constant between jumps on a line: its derivative is 0 there and carries no "
                "information; smooth the cost, as sigma= does"
            )
        if self._misses_jumps:
            problems.append(self._missed_text())
        for one in self.smoothed:
            if not one.defined:
                problems.append(f"nonfinite: at sigma {number(one.sigma)} J is not defined: {one.remark}")
            if one.hidden:
                problems.append(
                    f"spread: at sigma {number(one.sigma)} grad J is not distinguishable from 0 after {one.pairs} pairs"
                )
            if one.unshown:
                low, high = one.bias_percent
                problems.append(
                    f"spread: at sigma {number(one.sigma)} the bias of the mean gradient is "
                    f"{span(low, high)}% of grad J after {one.pairs} pairs, which does not show whether it is below "
                    f"{100 * TARGET_ERROR:g}%"
                )
            if one.biased:
                low, high = one.bias_percent
                why = ", though each gradient is right: it does not see the jumps" if self.derivative == RIGHT else ""
                problems.append(
                    f"biased: at sigma {number(one.sigma)} the mean of the gradients misses "
                    f"{span(low, high)}% of grad J{why}"
                )
        if self.noise_cause == "unmeasured":
            problems.append(f"unmeasured: {EXPLANATIONS['unmeasured']}")
        return sorted(problems, key=lambda text: not text.startswith(self.noise_cause))

    @property
    def conclusion(self) -> str:
        """The answer about the derivative in one line."""
        if self.derivative in (WRONG, UNSHOWN):
            first = self._derivative_problem()
            return f"Derivative: {self.derivative.upper()}. {first[:1].lower()}{first[1:]}"
        how = MEANING[self.derivative_cause].removeprefix("right").lstrip(":; ")
        if self.derivative == NONE:
            return f"Derivative: none given. By differences the cost has one here ({self.derivative_cause}: {how})"
        size = self._agreement()
        how = "at few steps" if self.is_quick else how
        how += "" if self.check is None or self.check.draws else ", at this theta only"
        return f"Derivative: right. {size} ({self.derivative_cause}: {how})"

    def _agreement(self) -> str:
        """Return how far a right gradient agrees with the differences."""
        assert self.check is not None
        parts = [part for part in self.check.components if part.difference != 0.0 and math.isfinite(part.error)]
        if not parts:
            return f"{self._n_checked()} checked"
        resolved = self._resolved_parts() or parts
        largest = max(part.error for part in resolved)
        doubt = max(part.uncertainty / abs(part.difference) for part in resolved)
        within = number(100 * max(largest, min(doubt, 1.0)), 1)
        few = len(parts) - len(resolved)
        rest = f", {few} of them only within rounding, since they are too small to resolve" if few else ""
        return f"{self._n_checked()} agree with differences to {within}%{rest}"

    def _resolved_parts(self) -> list[Part]:
        """Return the components whose differences have at least one correct digit."""
        parts = () if self.check is None else self.check.components
        return [part for part in parts if math.isfinite(part.error) and _is_resolved(part)]

    def _n_checked(self) -> str:
        n_seen = len(self.check.components) if self.check is not None else 0
        return f"{n_seen} of {counted(self.theta.size, 'component')}"

    @property
    def noise_answer(self) -> str:
        """The answer about the gradient under noise in one line."""
        if not self.gradient:
            return ""
        where = (
            f"Under noise of sigma {', '.join(number(one) for one in self.requested)}"
            if self.requested
            else "Around theta"
        )
        if self.derivative != RIGHT and not self.requested:
            where = "Under noise"
        if self.noise_cause and self.noise_cause != "unmeasured":
            answer = "not shown" if self.noise_cause in NOT_SHOWN else "NOT usable"
            return f"{where}: {answer}. {self._noise_problems()[0]}"
        if not self.smoothed or self.noise_cause:
            if self.derivative != RIGHT:
                answer = "not shown" if self.derivative == UNSHOWN else "not usable"
                return f"{where}: {answer}, since the derivative at theta is {self.derivative}"
            if not self.requested:
                return "Under noise: not measured, since no sigma is given"
            return f"{where}: not measured, since the budget ended"
        aside = "" if self.derivative == RIGHT else f", though the derivative at theta is {self.derivative}"
        worst = max(self.smoothed, key=lambda one: one.bias_high / one.norm if one.norm > 0 else math.inf)
        if not worst.known:
            return f"{where}: usable. Its mean is 0, as grad J{aside}"
        if not all(math.isfinite(one.bias) for one in self.smoothed):
            return f"{where}: not shown. A gradient there is not a number"
        bias = max(worst.bias_percent[1], 1e-3)
        return f"{where}: usable. The bias of the mean gradient is below {number(bias)}%{aside}"

    @property
    def warnings(self) -> list[str]:
        """The warnings as sentences: findings that are not problems but deserve attention."""
        warnings = []
        if self.is_expected:
            warnings.append(f"the cause is {self.cause}, as expected")
        elif self.expect == self.cause:
            warnings.append(f"expect={self.expect} excuses no wrong gradient")
        elif self.expect:
            warnings.append(f"expected {self.expect}, found {self.cause}: remove expect={self.expect} if that is right")
        if self.small_errors and self.derivative == RIGHT:
            part = self.small_errors[0]
            warnings.append(
                f"small error, within the tolerance: {self._size_of(part)}"
                + (f", and {len(self.small_errors) - 1} more" if len(self.small_errors) > 1 else "")
            )
        if self.check is not None and self.check.trusted:
            for verdict in NOTEWORTHY:
                parts = [self.label(part) for part in self.check.components if part.verdict == verdict]
                parts = self.zeros if verdict == "zero" else parts
                if verdict == "zero" and len(parts) == self.theta.size and self.moves_around:
                    continue  # they have an effect, beside theta
                if parts and self.derivative_cause not in ("zero", "no_effect"):
                    warnings.append(
                        f"{verdict}: {', '.join(parts[:6])}{' ...' if len(parts) > 6 else ''}: {EXPLANATIONS[verdict]}"
                    )
        if self.is_hidden_single:
            warnings.append(
                "precision: the cost has the digits of float32, though it returns a float64: it is checked as float32, "
                f"which detects errors above about {self.resolution}"
            )
        elif self.precision != "float64":
            warnings.append(
                f"{self.precision}: a check in {self.precision} detects errors above about {self.resolution}"
            )
        if self.is_small_spread and (self.spread > 0 or self.gradient_spread > 0):
            warnings.append(
                f"equal calls differ in the last digits, costs by {number(self.spread)}{self._relative(self.spread)}: "
                f"errors of the gradient below about {self.resolution} are not seen"
            )
        if self.elsewhere:
            warnings.append(
                f"the gradient raised an exception {self.n_failed} times away from theta: {shortened(self.elsewhere)}"
            )
        if self.printed.count:
            warnings.append(
                f"cost and gradient printed {counted(self.printed.count, 'line')}; the first: {shortened(self.printed.lines[0])}"
            )
        if not self.status and self.missed > SEEN and self.noise_cause not in ("jumps", "staircase"):
            warnings.append(self._missed_text())
        warnings += [f"not done within the budget: {what}" for what in self.left_out]
        return warnings

    @property
    def missed(self) -> float:
        """Largest share of the cost's change along a line that the integral of the gradient misses; 0 if unknown."""
        return max((line.missed for line in self.lines if math.isfinite(line.missed)), default=0.0)

    @property
    def has_steps(self) -> bool:
        """Whether the cost is constant between jumps on a line."""
        return any(line.steps for line in self.lines)

    @property
    def moves_around(self) -> bool:
        """Whether theta moves the cost beside a flat part at theta: by jumps on a line, or under noise."""
        return any(line.jumps for line in self.lines) or any(one.known for one in self.smoothed)

    @property
    def tread(self) -> float:
        """Height of the jumps, if all lines have equal, evenly spaced jumps; else 0."""
        treads = [line.tread for line in self.lines] or [0.0]
        return max(treads) if min(treads) > (1 - ALIKE) * max(treads) else 0.0

    def _missed_text(self) -> str:
        """Return how much of the cost's change the gradient misses, and what jumps of one height at even distances show."""
        text = (
            f"{'staircase' if self.tread else 'jumps'}: along a line the integral of the gradient misses {number(100 * self.missed)}% of the cost's change, "
            "which comes from jumps that no gradient sees"
        )
        if not self.tread:
            return text
        return (
            f"{text}: they have one height, {number(self.tread)}, at even distances on every line, so a part of the cost is "
            "rounded, cast to int or looked up on a grid"
        )

    @property
    def _unit(self) -> float:
        return 2.0**-7 if self.precision == "bfloat16" else float(np.finfo(self.precision).eps)

    @property
    def resolution(self) -> str:
        """The smallest relative error that the differences detect, as text in %: at least u^(2/3), as for central differences."""
        parts = self._resolved_parts()
        doubt = max((part.uncertainty / abs(part.difference) for part in parts), default=0.0)
        return f"{100 * max(self._unit ** (2 / 3), doubt):.1g}%"

    def label(self, part: Part) -> str:
        """Return a part's name: the name of its component of theta, or the name of its direction, ``direction 0``."""
        return self.names[part.component] if part.component is not None else part.name

    def sentence(self, check: Check) -> str:
        """Return the verdict of a failed check as a sentence, with the numbers of the worst part."""
        cause = self._same_factor(check) or EXPLANATIONS[check.cause] + self._evidence(check)
        if check.cause == "disconnected" and any(part.verdict in ("smooth", "nonlinear") for part in check.components):
            cause = "the gradient of some inputs is exactly 0 where the cost has a slope: they are detached"
        size = self._worst_size(check)
        if not size or check.cause in ("nan_gradient", "nonfinite"):
            return f"{check.cause}: {cause}" + (f" ({size})" if size else "")
        return f"{check.cause}: {cause} ({size})"

    def _evidence(self, check: Check) -> str:
        """Return what the numbers of a failed check say beyond its cause."""
        if check.cause == "nan_gradient":
            return self._where_not_a_number(check)
        if check.cause not in SUSPICIOUS:
            return ""
        wrong = [part for part in check.components if part.verdict == check.cause]
        if wrong and not any(part.sample.differences.any() for part in wrong):
            return ", and the cost does not move at all"
        if self._is_along_theta(check):
            return "; the error is along theta itself, as of a normalisation that is left out"
        ratios = ", ".join(number(part.ratio, 3) for part in wrong[:4])
        return f" ({ratios} times the derivative, by input)" if check.cause == "wrong_factor" and len(wrong) > 1 else ""

    def _same_factor(self, check: Check) -> str:
        """Return the factor of a gradient whose ratios to the differences are nearly the same, in words; else an empty string."""
        wrong = [part for part in (*check.components, *check.draws) if part.verdict == check.cause]
        ratios = np.array([part.ratio for part in wrong if math.isfinite(part.ratio)])
        if check.cause not in SUSPICIOUS or ratios.size < 2:
            return ""
        middle = float(np.median(ratios))
        if np.ptp(ratios) > SAME_FACTOR * abs(middle) or abs(middle - 1.0) <= SAME_FACTOR:
            return ""
        where = ", here and at other thetas" if any(part.component is None for part in wrong) else ""
        return f"{number(middle, 3)} times the derivative{where}: a factor or a sign is wrong, or a term in proportion to the rest"

    def _where_not_a_number(self, check: Check) -> str:
        """Return at which thetas or numbers of steps a gradient is not a number, with the likely reason."""
        whole = [one.steps for one in self.growth if math.isfinite(one.error)]
        broken = [one.steps for one in self.growth if not math.isfinite(one.error)]
        if whole and broken and max(whole) < min(broken):
            return (
                f": it is one after {max(whole)} steps and none from step {min(broken)} on, so look at the first steps"
            )
        here = not np.isfinite(check.gradient).all()
        good = [part for part in check.draws if math.isfinite(part.program)]
        sizes = [abs(part.program) for part in (*check.parts, *check.draws) if math.isfinite(part.program)]
        if np.isinf(check.gradient).any() or max(sizes, default=0.0) > OVERFLOWS:
            return ": it overflows, as in a rollout that amplifies: use fewer steps, or damp it"
        if not here:
            return f", at {len(check.draws) - len(good)} of {len(check.draws)} directions at other thetas, though not at theta itself"
        where = (
            f", at theta and at none of {len(check.draws)} directions at other thetas"
            if check.draws and len(good) == len(check.draws)
            else ""
        )
        return (
            f"{where}: a division, log, sqrt or norm at the edge of its domain, or a branch that 'where' discards only in the "
            "value"
        )

    def _is_along_theta(self, check: Check) -> bool:
        """Return whether the gradient's error is a multiple of theta, in at least two components."""
        parts = list(check.components)
        if len(parts) < max(self.theta.size, 2) or not all(math.isfinite(part.difference) for part in parts):
            return False
        error = np.array([part.program - part.difference for part in parts])
        at = np.array([self.theta[part.component or 0] for part in parts])
        size = float(np.linalg.norm(error) * np.linalg.norm(at))
        return bool(np.count_nonzero(at) > 1 and size > 0 and abs(float(error @ at)) > ALONG_THETA * size)

    def _named_parts(self, check: Check) -> list[Part]:
        """Return the worst parts that name an input: located groups, then components, then directions."""
        located = [part for part in check.parts if part.name in self.located]
        inside = [part for part in check.worst_parts if part.component is not None]
        exact = [part for part in inside if self.label(part) in self.located.values()]
        return exact or [*located, *inside] or list(check.worst_parts)

    def _worst_size(self, check: Check) -> str:
        parts = self._named_parts(check)
        if not parts:
            return ""
        part = max(parts, key=_distance)
        if check.cause == "kink":
            return f"{self.label(part)}: {number(part.left, 4)} and {number(part.right, 4)}"
        if check.cause not in FAULTS or not self.gradient:
            return self.label(part)
        return self._size_of(part) + (f", and {len(parts) - 1} more" if len(parts) > 1 else "")

    def _size_of(self, part: Part) -> str:
        """Return a part's error in words, with the numbers behind it."""
        name = self.label(part)
        if part.name in self.located:
            name = f"{self.located[part.name]}, along a random direction,"
        good = abs(part.uncertainty / part.difference) if part.difference else math.nan
        text = f"{name}: program {_as_text(part.program)}, differences {_as_text(part.difference)}"
        if math.isfinite(part.error):
            ratio = part.program / part.difference if part.difference else math.inf
            how = f"off by {number(100 * abs(ratio - 1))}%" if part.difference else "is not 0"
            if 2 < ratio < math.inf:
                how = f"is {number(ratio, 3)} times too large"
            elif ratio < 0:
                how = f"has the wrong sign and {number(-ratio, 3)} times the size"
            text = f"{name} {how}: program {_as_text(part.program)}, differences {_as_text(part.difference)}"
        return text + (f", good to {number(good, 1)}" if math.isfinite(good) else "")

    # ---------------------------------------------------------------------------------------------- tables

    @property
    def frame(self) -> pd.DataFrame:
        """A row per checked derivative: the program's value, the difference, and the verdict."""
        import pandas as pd

        parts = [(self.label(part), part) for part in (*self.check.parts, *self.check.draws)] if self.check else []
        has_gradient = bool(self.gradient)
        return pd.DataFrame(
            {
                "name": [name for name, _ in parts],
                "program": [part.program if has_gradient else math.nan for _, part in parts],
                "difference": [part.difference for _, part in parts],
                "uncertainty": [part.uncertainty for _, part in parts],
                "step": [part.step for _, part in parts],
                "ratio": [part.ratio if has_gradient else math.nan for _, part in parts],
                "left": [part.left for _, part in parts],
                "right": [part.right for _, part in parts],
                "order": [part.order if has_gradient else math.nan for _, part in parts],
                "verdict": [part.verdict for _, part in parts],
            }
        )

    @property
    def sigmas(self) -> pd.DataFrame:
        """A row per sigma and method: the bias, and the cost of a relative error of 10%."""
        import pandas as pd

        rows = []
        for one in self.smoothed:
            base = dict(
                sigma=one.sigma, norm=one.norm, norm_se=one.error, pairs=one.pairs, bias=one.bias, bias_low=one.bias_low,
                bias_high=one.bias_high, moved=one.moved, remark=one.remark,
            )  # fmt: skip
            for method in one.methods:
                recommended = self.recommended(one)
                best = recommended is not None and recommended.name == method.name
                rows.append(
                    base
                    | dict(
                        method=method.name,
                        samples=method.samples,
                        calls=method.calls,
                        seconds=method.seconds,
                        best=best,
                    )
                )
            if not one.methods:
                rows.append(base | dict(method="", samples=math.nan, calls=math.nan, seconds=math.nan, best=False))
        return pd.DataFrame(rows)

    @property
    def breaks(self) -> pd.DataFrame:
        """A row per jump or kink: line, position in standard deviations, size, and the first numbers of theta there."""
        import pandas as pd

        moved = range(min(self.theta.size, SHOWN))
        rows = [
            dict(line=index + 1, kind=b.kind, at=b.at, size=b.size)
            | {self.names[i]: self.theta[i] + b.at * line.direction[i] for i in moved}
            for index, line in enumerate(self.lines)
            for b in line.breaks
        ]
        return pd.DataFrame(rows, columns=["line", "kind", "at", "size", *(self.names[i] for i in moved)])

    # ------------------------------------------------------------------------------------------------ text

    def __str__(self) -> str:
        parts = [
            self._answers(), self._scope(), self._head(), self._components(), self._growth(), self._breaks(), self._sigmas(),
            self._exception(),
        ]  # fmt: skip
        return "\n\n".join("\n".join(part) for part in parts if part)

    def _answers(self) -> list[str]:
        lines = [self.conclusion]
        lines += [f"  {text}" for text in self.problems[1:] if self.derivative in (WRONG, UNSHOWN)]
        lines += [self.noise_answer] if self.noise_answer else []
        if self.noise_cause:  # the answer states the first problem
            lines += [f"  {text}" for text in self._noise_problems()[1 if self.noise_answer else 0 :]]
        lines += [f"since the baseline: {text}" for text in self.changes]
        return lines + [f"warning: {text}" for text in self.warnings]

    def _scope(self) -> list[str]:
        """Return lines that state what was checked, what was not, and what to do next."""
        lines = []
        if self.check is not None:
            check = self.check
            whole = [part for part in check.parts if part.component is None]
            groups = [part for part in whole if not part.name.startswith("direction ")]
            steps = max((part.sample.step.size for part in check.parts), default=0)
            text = f"checked: {self._n_checked()}"
            text += f", {counted(len(groups), 'group')} of numbers" if groups else ""
            n_random = len(whole) - len(groups)
            text += f" and {counted(n_random, 'random direction')}" if n_random else ""
            text += f" at theta, {counted(steps, 'step')} each"
            if check.draws:
                text += f", {counted(len(check.draws), 'direction')} at other thetas around it"
            if self.lines:
                text += f", jumps on {counted(len(self.lines), 'line')}"
            if self.smoothed:
                text += f", noise of sigma {', '.join(number(one.sigma) for one in self.smoothed)}"
            if self.twin is not None:
                text += f", the twin (differs by {number(100 * self.twin)}%)"
            lines.append(text)
        rest = [] if self.gradient else ["any gradient"]
        limit = "calls" if math.isfinite(self.calls) and not math.isfinite(self.budget) else "budget"
        rest += [f"{what} ({limit})" for what in self.left_out]
        if self.smoothed and self.gradient:
            rest.append(
                f"jumps that fewer than 3 in {2 * min(one.pairs for one in self.smoothed)} draws of the noise meet"
            )
        if self.hidden:
            rest.append(
                f"the numbers of a group one by one: an error of one number below {number(100 * self.hidden)}% of their root mean "
                "square (gradient times scale) may not show"
            )
        is_said = any("other thetas" in what for what in self.left_out)
        if self.gradient and self.check is not None and not self.check.draws and not is_said:
            cut = f" ({limit})" if self.left_out or math.isfinite(self.calls) else ""
            rest.append(f"the gradient at other thetas around this one{cut}")
        rest += (
            ["the gradient under noise on theta (no sigma)"]
            if self.gradient and not self.requested and not self.smoothed
            else []
        )
        lines.append(f"not checked: {'; '.join([*rest, 'thetas far from this one'])}")
        advice = self.advice
        return [*lines, f"next: {advice}"] if advice else lines

    @property
    def advice(self) -> str:
        """The next step, with the setting that takes it."""
        cause = self.cause
        longer = (
            f"calls={int(2 * self.calls)}" if math.isfinite(self.calls) else f"budget={max(2 * self.budget, 60.0):.0f}s"
        )
        if cause in ("undecided", "unmeasured") or (cause == "unsettled" and self.left_out):
            is_new = cause == "undecided" and self.wrong_checks and self.refined is None
            refined = ", or refined=COST, the cost at a tighter tolerance" if is_new else ""
            return f"{self._again(longer)}: the rest needs more calls{refined}"
        if cause in ("kink", "jump"):
            return f"choose a theta beside the {cause}, or {self._again(f'expect={cause}')} if it is known"
        if cause == "adaptive":
            if self.refined is not None:
                return f"{self._again('expect=adaptive')} if the gradient is meant to be that of the refined cost"
            return f"{self._again('refined=COST')}, the cost at a tighter tolerance, and compare"
        costs = "estimate the gradient from costs (smoothing)"
        if any(self.recommended(one) is not None for one in self.smoothed):
            costs += ", as the table recommends"
        if cause == "spread" and any(one.unshown and one.pairs < PAIRS for one in self.smoothed):
            return f"{self._again(longer)}: more pairs narrow the interval; or {costs}"
        if cause in ("biased", "jumps", "spread", "staircase"):
            return costs
        if cause == "nondeterministic":
            return "fix the seed, or pass the noise as w and set noise=N; reset states that persist between calls"
        if cause == "overwritten":
            return "use one tape per step, or arrays of its own for each step; check with twin_grad=GRADIENT"
        if cause in ("zero", "no_effect"):
            return f"check that these inputs reach the simulator, or {self._again('allow_zero=NAME')}"
        if cause in SUSPICIOUS or cause == "disconnected":
            parts = self._named_parts(self.wrong_checks[0]) if self.wrong_checks else []
            names = ", ".join(self.located.get(part.name, self.label(part)) for part in parts[:3]) or "the cost"
            has_jumps, is_near = any(line.jumps for line in self.lines), may_be_adaptive(self.wrong_checks[0])
            more = [] if self.growth else ["; horizons=1,2,5 if it takes steps=T"]
            if self.refined is None and (has_jumps or is_near):
                adapts = (
                    "its steps adapt to theta"
                    if has_jumps
                    else "the gradient is of the equations, with a discretisation of its own"
                )
                more.append(f"; refined=COST if {adapts}")
            return f"follow {names} through the cost: cut it into parts until the ratio is 1{''.join(more)}"
        if cause in TRUSTED and self.gradient and not self.requested:
            return f"{self._again('sigma=SIGMA')} for use under noise"
        return ""

    def _again(self, setting: str) -> str:
        """Return the command of this report with another setting."""
        name = setting.partition("=")[0]
        return f"{re.sub(rf' {name}=[^ ]+', '', self.command)} {setting}" if self.command else setting

    def _exception(self) -> list[str]:
        text = self.error or self.elsewhere
        return ["The gradient's exception:", f"  {text}"] if len(text) > HEADLINE else []

    def _growth(self) -> list[str]:
        if not self.growth:
            return []
        rows = [["steps", "error of the gradient", "differences good to"]]
        rows += [
            [str(one.steps), f"{number(100 * one.error)}%", f"{number(100 * one.uncertainty, 1)}%"]
            for one in self.growth
        ]
        return ["The gradient after fewer or more steps:", *_table(rows)]

    def _head(self) -> list[str]:
        first = [(self.names[i], self.theta[i]) for i in range(min(6, self.theta.size))]
        point = ", ".join(f"{name}={value:g}" for name, value in first)
        point += f", ... ({self.theta.size:,} numbers)" if self.theta.size > 6 else ""
        repeats = "repeats exactly"
        if not self.repeats:
            how = "repeats up to the last digits" if self.is_small_spread else "DOES NOT REPEAT"
            repeats = f"{how}: calls differ by {number(self.spread)}"
        if self.repeats and self.check is not None and self.check.noise > 0:
            repeats += f", rough by {number(self.check.noise)}"
        lines = [
            f"{self.name}: cost {self.cost:.6g} at {point}",
            f"{self.precision}, {repeats}; gradient: {self.gradient or 'none, only differences'}; batch: {self.batch}",
        ]
        spent = f"spent: {counted(self.costs, 'cost')}"
        if self.gradient:
            spent += f" and {counted(self.gradients, 'gradient')}"
        limit = f" of {duration(self.budget)}" if math.isfinite(self.budget) else ""
        spent += f" in {duration(self.seconds)}{limit}, first calls {duration(self.compile_s)}"
        if self.elapsed > LATE * (self.seconds + self.compile_s) + 1.0:
            spent += f" ({duration(self.elapsed)} on the clock, since other programs used the processors)"
        spent += f"; a cost takes {duration(self.cost_s)}"
        if math.isfinite(self.gradient_s):
            spent += f", a gradient {duration(self.gradient_s)}"
        return [*lines, spent, *(f"note: {note}" for note in self.notes)]

    def _components(self) -> list[str]:
        if self.check is None:
            return []
        check = self.check
        head = ["", "program", "differences", "step", "ratio", "verdict"]
        rows = [head]
        whole = [part for part in check.parts if part.component is None]
        for part in (*check.components, *whole):
            rows.append(
                [
                    self.label(part),
                    _as_text(part.program) if self.gradient else "-",
                    f"{_as_text(part.difference)} +- {number(part.uncertainty, 1)}",
                    number(part.step, 1),
                    number(part.ratio, 5) if self.gradient else "-",
                    part.verdict,
                ]
            )
        title = "Is the gradient right?" if self.gradient else "The derivative by differences:"
        lines = [title, *_table(rows)]
        if check.draws:
            wrong = [part for part in check.draws if part.verdict in FAULTS]
            lines.append(
                f"  elsewhere: {counted(len(check.draws), 'direction')} at other thetas around this one, "
                + (f"{len(wrong)} wrong: {wrong[0].verdict}" if wrong else "none wrong")
            )
        orders = [
            part.order for part in (check.parts if check.trusted else check.worst_parts) if math.isfinite(part.order)
        ]
        if self.gradient and orders:
            order = float(np.median(orders)) if check.trusted else min(orders)
            # curvature hides a small error at wide steps: an order near 2 would contradict the verdict
            if check.trusted or order < CLEAR_ORDER:
                lines.append(
                    f"  Taylor remainder |f(x + h d) - f(x) - h g.d|: order {order:.2f} in h (2 right, 1 wrong)"
                )
        return lines

    def _breaks(self) -> list[str]:
        if not self.lines:
            return []
        unit = "of each input's scale" if self.relative else "on theta"
        count = counted(len(self.lines), "line")
        lines = [f"Jumps and kinks on {count} through theta, +-3 sigma (sigma = {number(self.reach)} {unit}):"]
        for index, line in enumerate(self.lines):
            remarks = []
            for kind, breaks in (("jump", line.jumps), ("kink", line.kinks)):
                if breaks:
                    first = ", ".join(f"{b.at:+.3f}{self._place(line, b.at)} ({number(b.size)})" for b in breaks[:4])
                    size = "height" if kind == "jump" else "change of slope"
                    remarks.append(
                        f"{counted(len(breaks), kind)} at t = {first}{' ...' if len(breaks) > 4 else ''} [{size}]"
                    )
            bad = int((~np.isfinite(line.costs)).sum())
            if bad:
                remarks.append(f"{bad} of {line.costs.size} costs are not numbers")
            if math.isfinite(line.missed):
                remarks.append(
                    f"the gradient's integral explains {number(100 * (1 - line.missed), 4)}% of the cost's change"
                )
            if line.steps:
                remarks.append("constant between jumps: a staircase")
            if not line.breaks:
                remarks.insert(0, "none found")
            lines.append(f"  line {index + 1}: {'; '.join(remarks)}")
        if any(len(line.breaks) > 5 for line in self.lines):
            lines.append("  at most six places are searched on a line, so there may be more")
        return lines

    def _place(self, line: LineScan, at: float) -> str:
        """Return the numbers of theta at a place on a line, where there are few."""
        if self.theta.size > 3:
            return ""
        return f", theta = {', '.join(f'{value:.5g}' for value in self.theta + at * line.direction)}"

    def _sigmas(self) -> list[str]:
        if not self.smoothed:
            return self._without_noise()
        unit = ", relative to each input's scale" if self.relative else ""
        rows = [["sigma", "|grad J|", "bias of the gradient", "smoothing changes it by", "use", "10% error costs"]]
        remarks = []
        for one in self.smoothed:
            rows.append(
                [
                    number(one.sigma),
                    f"{number(one.norm, 3)} +- {number(one.error, 1)}"
                    if one.error or one.norm
                    else "no draw moved the cost",
                    self._bias(one),
                    f"{number(100 * one.moved / one.norm)}%" if math.isfinite(one.moved) and one.known else "-",
                    *self._use(one),
                ]
            )
            if one.remark:
                remarks.append(f"  sigma {number(one.sigma)}: {one.remark}")
        return [f"With noise of sigma on theta{unit}, J = E cost:", *_table(rows), *remarks]

    def _bias(self, one: Smoothed) -> str:
        if not math.isfinite(one.bias):
            return "-"
        if not one.known:
            return "unknown"
        low, high = one.bias_percent
        if one.bias_high > one.norm and not one.biased:
            return "unknown: the gradients vary too widely"
        if low <= 0:
            return f"none seen, below {number(high)}%"
        return f"{number(100 * one.bias / one.norm)}% [{number(low)}, {number(high)}]"

    def recommended(self, one: Smoothed) -> Method | None:
        """Return the fastest usable method at a sigma; None if none is known."""
        best = one.best
        if best is not None and best.name == "gradient" and self.derivative == WRONG:
            return next((m for m in one.methods if m.name == "smoothing" and math.isfinite(m.seconds)), None)
        return best

    def _use(self, one: Smoothed) -> tuple[str, str]:
        best = self.recommended(one)
        if best is None:
            return "unknown", "-"
        kind = "gradient" if best.name == "gradient" else "cost"
        return f"{best.name}, N = {int(best.samples):,}", f"{counted(int(best.calls), kind)}, {duration(best.seconds)}"

    def _without_noise(self) -> list[str]:
        """Return the lines of the recommendation for use without noise."""
        if self.check is None or self.status:
            return []
        dim = self.theta.size
        lines = [f"Without noise: central differences take {2 * dim} costs, {duration(2 * dim * self.cost_s)}"]
        if self.gradient and math.isfinite(self.gradient_s):
            fewer = "use the gradient" if self.gradient_s < 2 * dim * self.cost_s else "differences are no slower"
            lines[0] += f"; the gradient {duration(self.gradient_s)}: {fewer}"
        return lines


@np.errstate(all="ignore")
def _distance(part: Part) -> float:
    """Return how far a part's derivative is from its difference, relative to the difference, as headlines state it."""
    apart = float(np.float64(abs(part.program - part.difference)) / np.float64(abs(part.difference)))
    return math.inf if math.isnan(apart) else apart


def shortened(text: str) -> str:
    """Return the first characters of a text on one line, for a headline."""
    line = " ".join(text.split())
    return line if len(line) <= HEADLINE else f"{line[:HEADLINE]} ..."


def _as_text(value: float) -> str:
    """Return a derivative as text; ``NaN`` where it is not a number."""
    return "NaN" if math.isnan(value) else number(value, 6)


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows as lines of text with aligned columns."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
