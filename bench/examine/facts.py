"""The facts of an examination: what was measured, and what follows from the numbers for the order of verdicts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bench.examine.diagnosis import GROWTH, Horizon, doubtful, may_be_adaptive
from bench.examine.judged import JudgedCheck
from bench.examine.means import OF_A_DRAW, Mean
from bench.examine.smoothing import Smoothed
from bench.examine.stages import Repeats
from bench.gradient import FAULTS, TRUSTED, Check, Part, Sample
from bench.gradient.direction import MIN_STEPS
from bench.gradient.rules import EXCUSABLE, SUSPICIOUS, UNEQUAL
from bench.report.text import counted, number, span

SEEN = 0.01
"""Share of a cost's change along a line that the integral of the gradient may miss without a warning."""
RESOLVED = 0.02
"""Relative error of a difference, up to which it shows that a component is right."""
DIGIT = 0.1
"""Largest uncertainty of a difference that shows a derivative, relative to the derivative or to slopes nearby."""
CONTRADICTED = 10.0
"""Uncertainties of a difference from which a derivative is not called right, even if it is small beside the others."""
SLIGHT = 1e-5
"""Largest error of an unresolved derivative, relative to the largest derivative, both in units of the inputs' scales."""
PART = 0.5
"""Largest share of such a slope that the gradient has: a factor or a sign is wrong however small the slope."""
AS_FAR = 4.0
"""Largest distance of a gradient from a refined cost, relative to that of the cost's own differences, over all thetas together: where the
steps depend on theta, the gradient has its own error."""
RESIDUE = 1e-4
"""Largest change of the cost by a gradient, relative to the height of a jump, that is a residue of a solver."""
TINY = 1e-8
"""Scale of an input below which a slope that no difference shows counts, however small its change of the cost over the scale."""
HEADLINE = 200
"""Most characters of an exception in a headline."""
NOISE_CAUSES = ("staircase", "jumps", "nonfinite", "nan_gradient", "biased", "spread", "unmeasured")
"""Causes around theta or under noise, the first one decides."""


def as_text(value: float, digits: int = 6) -> str:
    """Return a number as text; ``NaN`` where it is not a number."""
    return "NaN" if math.isnan(value) else number(value, digits)


def shortened(text: str) -> str:
    """Return the first characters of a text on one line, for a headline."""
    line = " ".join(text.split())
    return line if len(line) <= HEADLINE else f"{line[:HEADLINE]} ..."


@np.errstate(all="ignore")
def _slope_nearby(sample: Sample) -> float:
    """Return the largest one-sided slope of a sample that exceeds its noise, less the noise."""
    slopes = np.maximum(np.abs(sample.left), np.abs(sample.right)) - 3.0 * sample.uncertainty
    return float(slopes.max(initial=0.0, where=np.isfinite(slopes)))


@dataclass(frozen=True)
class Facts(JudgedCheck):
    """The facts about a cost and its gradient at one theta, from which verdicts follow."""

    gradient: str
    """Source of the gradient: ``jax``, ``torch``, a function's name, or empty for differences only."""
    cost: float
    repeats: Repeats
    is_complete: bool
    """Whether every chosen component and group was checked."""
    located: dict[str, tuple[int, int]]
    """By name of a wrong group: the first of the numbers that cause its error, and the last + 1."""
    is_random: bool
    """Whether the cost has noise of its own."""
    means: Mean | None
    """The mean of a gradient that is not the derivative at a fixed draw of the cost's noise; None: not compared."""
    smoothed: Sequence[Smoothed]
    error: str
    """The first exception that the gradient raised; empty if none."""
    is_failed: bool
    """Whether it did at theta."""

    @cached_property
    def unresolved(self) -> list[Part]:
        """The components that the check accepts, though differences cannot see them or contradict them.

        A component is seen if its difference has one correct digit, compared with the derivative or with the slopes of
        wider steps, which are not 0 at a minimum; one that is not small beside these has to be known to :data:`RESOLVED`. Unseen
        components that are small do not count, unless their input is so small that it need not be its own scale.
        """
        parts = [p for p in self.settled.components if p.verdict in TRUSTED and p.verdict != "zero"]
        sizes = {p.name: max(abs(p.difference), _slope_nearby(p.sample)) for p in parts}
        seen = [p for p in parts if p.uncertainty < DIGIT * sizes[p.name]]
        largest = max((abs(p.difference) * p.sample.scale for p in seen), default=0.0)
        hidden = [
            p
            for p in parts
            if (p.uncertainty >= RESOLVED * sizes[p.name] and abs(p.program) * p.sample.scale >= DIGIT * largest)
            or (p not in seen and p.sample.scale < TINY)
        ]
        contradicted = [
            p
            for p in seen
            if self._is_contradicted(p)
            and p.error > DIGIT
            and p.uncertainty < DIGIT * abs(p.difference)
            and not self._is_small(replace(p, verdict="wrong_adjoint"))
        ]
        return hidden + contradicted

    @property
    def resolved_parts(self) -> list[Part]:
        """The components whose differences have at least one correct digit."""
        return [p for p in self.named.components if p.uncertainty < DIGIT * abs(p.difference)]

    @property
    def zeros(self) -> list[str]:
        """The inputs without any effect that ``allow_zero`` does not name."""
        allowed = self.setup.allow_zero
        return [
            self.label(p)
            for p in self.check.components
            if p.verdict == "zero" and (allowed is None or not allowed[p.component])
        ]

    @cached_property
    def failures(self) -> list[tuple[float, str, float]]:
        """Where the cost is not a number or raises an exception: distance in units of the scales, name, displacement.

        The nearest place is first.
        """
        ways = []
        for part in self.check.parts:
            one = part.sample
            steps, costs = np.r_[-one.step, one.step], np.r_[one.minus, one.plus]
            ways.append((self.label(part), steps, costs, 1.0 / one.scale))
        for index, line in enumerate(self.lines, 1):
            length = float(np.linalg.norm(line.direction / self.setup.scale))
            ways.append((f"t on line {index}", line.at, line.costs, length))
        lost = ((name, at, length) for name, t, costs, length in ways for at in t[~np.isfinite(costs)].tolist())
        return sorted((abs(at) * length, name, at) for name, at, length in lost)

    @property
    def place(self) -> str:
        """The nearest place where the cost is not a number; empty without one."""
        if not math.isfinite(self.cost):
            return f"the cost at theta itself is {as_text(self.cost)}"
        inputs = [self.label(part) for part in self.check.components]
        known = [place for place in self.failures if place[1] in inputs] or self.failures
        return "".join(f"nearest at {name} {at:+.2g}" for _, name, at in known[:1])

    # ---------------------------------------------------------------------------------------------- equal calls

    @property
    def is_noisy(self) -> bool:
        """Whether equal calls of the cost differ by more than a floor, and not because of the call before."""
        is_unrepeated = any(part.verdict == "nondeterministic" for part in self.settled.parts)
        return (is_unrepeated or self.repeats.spread > self.repeats.floor) and not self.repeats.has_state

    @property
    def exceeds_noise(self) -> bool:
        """Whether the gradient of a noisy cost is wrong; one with noise of its own by more than all noise makes."""
        has_noise = self.repeats.of_gradient > self.repeats.floor_of_gradient
        if has_noise or self.settled.cause == "nondeterministic":
            return any(p.verdict in FAULTS and self._is_contradicted(p) for p in self.settled.components)
        return self.settled.cause in FAULTS

    def _is_contradicted(self, part: Part) -> bool:
        """Return whether a difference contradicts a derivative beyond its error and all noise of equal calls."""
        repeats = self.repeats
        noise = repeats.of_gradient * np.linalg.norm([p.program for p in self.settled.components])
        error = part.uncertainty + repeats.spread / part.step + noise
        return bool(part.apart > CONTRADICTED * error)

    @property
    def spread_text(self) -> str:
        """How far equal calls differ."""
        costs, gradients = number(self.repeats.spread), number(100 * self.repeats.of_gradient)
        state = ", the cost depends on the call before it" * self.repeats.has_state
        return f"costs differ by {costs}, gradients by {gradients}%{state}"

    @property
    def error_text(self) -> str:
        """The first exception that the gradient raised, shortened to a headline."""
        return shortened(self.error)

    # ------------------------------------------------------------------------------------ what a failed check shows

    @cached_property
    def wrong_checks(self) -> list[Check]:
        """The failed checks: at theta, and under other noise."""
        return [one for one in [self.settled, *self.more] if one.parts and not one.trusted]

    @cached_property
    def failed(self) -> str:
        """The verdict of the first failed check; empty if none failed."""
        return self.wrong_checks[0].cause if self.wrong_checks else ""

    @property
    def is_suspicious(self) -> bool:
        """Whether a check failed with a cause that adaptive steps and kinks imitate."""
        return self.failed in SUSPICIOUS

    @cached_property
    def failed_text(self) -> str:
        """The numbers of the worst part of the failed check, and the explanation that fits; empty if none failed."""
        if self.failed == "nonfinite":
            return self.place
        text = self.numbers(self.wrong_checks[0].worst_of(self.culprits)) if self.culprits else ""
        return f"{text}, {self.hint.text}" if self.hint and self.is_suspicious else text

    @property
    def culprits(self) -> list[Part]:
        """The worst parts of the failed check that name an input: located groups, then components, then directions."""
        if not self.wrong_checks:
            return []
        check = self.wrong_checks[0]
        inside = [part for part in check.worst_parts if part.component is not None]
        exact = [part for part in inside if part.component in self._located_numbers]
        return (
            exact or [*(part for part in check.parts if part.name in self.located), *inside] or list(check.worst_parts)
        )

    @property
    def _located_numbers(self) -> set[int]:
        return {first for first, last in self.located.values() if last - first == 1}

    @property
    def is_slight(self) -> bool:
        """Whether the gradient has little of slopes that are so small beside right ones that a solver's error may make them."""
        check = self.wrong_checks[0]
        right = [part for part in check.components if part.verdict in TRUSTED]
        largest = max((abs(part.difference) * part.sample.scale for part in right), default=0.0)
        wrong = [part for part in (*check.parts, *check.draws) if part.verdict in UNEQUAL]
        return bool(wrong) and all(
            part.apart * part.sample.scale <= SLIGHT * largest and abs(part.program) <= PART * abs(part.difference)
            for part in wrong
        )

    @property
    def is_discretisation_gap(self) -> bool:
        """Whether evidence of its own says that a wrong gradient is that of another discretisation of the same problem.

        Either the gradient agrees with a refined cost where the cost's own differences do not, at every theta compared. Or
        the steps depend on theta, and the error is of the size of the jumps that this makes, or of a refined cost's gap.
        """
        is_varied = bool(self.explained.steps)
        if self.failed not in EXCUSABLE or self._is_decided:
            return False
        if self.explained.refined is None:
            return is_varied and bool(self.explained.is_adaptive)
        is_near = all(np.linalg.norm(gradient) <= AS_FAR * np.linalg.norm(own) for gradient, own in self._gaps)
        return self._agrees_with_refined or (is_varied and is_near)

    @property
    def _is_decided(self) -> bool:
        """Whether the slope of a rough cost's smooth part is known beyond doubt about its sequences of steps."""
        return bool(self.explained.wide) and (self.explained.refined is not None or self._is_averaged)

    @property
    def _is_averaged(self) -> bool:
        """Whether wide steps meet several sequences of steps, along each wrong part: the slope over them is another than at tiny steps."""
        smooth, wrong = self.explained.smooth_parts, {p.name for p in self.settled.parts if p.verdict in UNEQUAL}
        known = [(part, wide) for part in self.check.parts if (wide := smooth.get(part.name))]
        is_other = any(abs(wide.slope - part.difference) > wide.error + part.uncertainty for part, wide in known)
        return is_other and wrong <= {part.name for part, _ in known}

    @property
    def may_be_explained(self) -> bool:
        """Whether adaptive steps may explain the error, and the budget ended before that was known."""
        explained = self.explained
        steps, is_small = bool(explained.steps), may_be_adaptive(self.check)
        unseen = {part.name for part in doubtful(self.check.parts, self.groups)} - {*explained.smooth_parts}
        is_unknown = explained.is_adaptive is None and (steps or is_small)
        # breaks that do not explain a large error rule out what the smooth part could still show
        is_unknown |= steps and is_small and bool(unseen)
        return explained.refined is None and not self._is_decided and is_unknown

    @property
    def grows(self) -> bool:
        """Whether the gradient is right after few steps, and its error grows with their number."""
        growth, late = self.explained.growth, self._late
        if not late or growth[0] in late:
            return False
        return growth[-1] in late and (len(late) == 1 or growth[-1].error > GROWTH * late[0].error)

    @property
    def latest(self) -> Horizon | None:
        """The most wrong of the compared numbers of steps; None if the gradient is right at all."""
        return max(self.explained.growth, key=lambda one: one.error) if self._late else None

    @property
    def _late(self) -> list[Horizon]:
        """The compared numbers of steps after which the gradient is wrong."""
        tolerance = max(float(self.setup.rtol.max()), 1e-3)
        return [one for one in self.explained.growth if one.is_wrong(tolerance)]

    # -------------------------------------------------------------------------------------------- around theta

    @property
    def is_of_a_draw(self) -> bool:
        """Whether the failure is at one draw of the cost's noise, which an estimator need not match.

        A gradient that follows the slopes of the draws, and whose mean is off, is none.
        """
        means = self.means
        follows = means and means.is_of_draws and means.is_decisive and means.cause == "biased"
        return self.is_random and self.failed in OF_A_DRAW and not follows

    @property
    def cause_of_mean(self) -> str:
        """The verdict on a gradient that is not the derivative of each draw, but may be an estimator."""
        if self.means and self.means.is_decisive:
            return self.means.cause
        causes = [one.cause or ("estimator" if one.is_usable else "spread") for one in self.smoothed]
        return min(causes, key=(*NOISE_CAUSES, "estimator").index, default="unmeasured")

    @property
    def mean_text(self) -> str:
        """By how much the mean of a gradient over draws is off."""
        means = self.means
        if means and means.n_lost:
            return f"at {means.n_lost} of {means.draws} draws"
        if means and means.is_decisive:
            off = span(100 * max(means.error - means.doubt, 0.0), 100 * (means.error + means.doubt))
            return f"its mean over {means.draws} draws is off by {off}%"
        known = [one for one in self.smoothed if one.known]
        return "".join(f"its mean is off by {span(*one.bias_percent)}%, at sigma {one.sigma:g}" for one in known[:1])

    @property
    def is_on_tread(self) -> bool:
        """Whether the cost is constant at the smallest steps beside jumps: wider steps meet them, or the gradient is a residue."""
        parts = self.check.components or self.check.parts
        wrong = [part for part in parts if part.verdict in (*SUSPICIOUS, "unsettled")]
        height = max((jump.size for line in self.lines for jump in line.jumps), default=0.0)
        return bool(height and wrong) and all(
            not part.sample.differences[-MIN_STEPS:].any()
            and (part.sample.differences.any() or abs(part.program) * part.sample.scale <= RESIDUE * height)
            for part in wrong
        )

    @property
    def has_steps(self) -> bool:
        """Whether the cost is constant between jumps on a line."""
        return any(line.steps for line in self.lines)

    @property
    def moves_around(self) -> bool:
        """Whether theta moves the cost beside a flat part at theta: by jumps on a line, or under noise."""
        return any(line.jumps for line in self.lines) or any(one.n_moved for one in self.smoothed)

    # -------------------------------------------------------------------------------------------------- names

    @property
    def n_checked(self) -> str:
        """How many components were checked, ``2 of 3 components``."""
        return f"{len(self.check.components)} of {counted(self.theta.size, 'component')}"

    def label(self, part: Part) -> str:
        """Return a part's name: the name of its component of theta, or the name of its direction, ``direction 0``."""
        return part.name if part.component is None else self.layout.name(part.component)

    def numbers(self, part: Part) -> str:
        """Return a part's numbers: the program's, the difference, and how far they are apart; at a kink both slopes."""
        name = self.label(part)
        if part.name in self.located:
            name = f"{self.layout.block(*self.located[part.name])}, along a random direction"
        if part.verdict == "jump":
            return name
        if part.verdict == "kink":
            return f"{name}: slopes {number(part.left, 4)} and {number(part.right, 4)}"
        given = f"program {as_text(part.program)}, " if self.gradient else ""
        off = f", off by {number(100 * part.distance)}%" if self.gradient and math.isfinite(part.distance) else ""
        return f"{name}: {given}differences {as_text(part.difference)} +- {number(part.uncertainty, 1)}{off}"
