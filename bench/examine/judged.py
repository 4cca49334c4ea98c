"""The check of a gradient and the settings it is held to, judged by what an examination compares after the check.

The same check has four versions, and each is the one before it with other verdicts on some derivatives:

1. :attr:`JudgedCheck.check`: what differences of the cost at tiny steps show.
2. :attr:`JudgedCheck.judged`: a derivative of a rough cost has the verdict that wide steps or a refined cost give.
3. :attr:`JudgedCheck.named`: a wrong derivative has the cause that explains the numbers of all of them.
4. :attr:`JudgedCheck.settled`: a wrong derivative is right where its error is within the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from bench.examine.diagnosis import LOOSE, Explanation, doubtful
from bench.examine.hints import Hint, hint_of
from bench.examine.lines import ALIKE, LineScan
from bench.examine.stages import recaused
from bench.gradient import Check, Part, rules
from bench.gradient.direction import resolution
from bench.gradient.roughness import FINE
from bench.gradient.rules import SUSPICIOUS, UNEQUAL
from bench.gradient.smooth_part import CLEAR, LIMIT
from bench.report.text import span
from bench.simulator.simulator import unit_of
from bench.simulator.tree import ParameterTree

RELATIVE = 0.01
"""Default sigma of the line scans, and of a cost with its own noise, in units of each input's scale."""
DEVIATIONS = 4.0
"""Standard deviations of the slope along a random direction that errors within the tolerance do not exceed."""
SEEN_ALONE = 4.0
"""Multiple of a slope's error from which the error of one number shows along most random directions."""
AGREES = 0.5
"""Largest distance of a gradient that agrees with a refined cost, relative to that of the cost's own differences."""
ROUGH = 0.1
"""Share of the cost's change over the widest step that noise between neighbouring thetas makes up where a cost is rough."""


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
class Setup:
    """The settings of an examination, per entry of theta where they are arrays ``(d,)``."""

    levels: Sequence[tuple[float, np.ndarray]]
    """Each sigma as a number for tables, its largest entry, and as an array."""
    scale: np.ndarray
    rtol: np.ndarray
    """Tolerated relative error of each derivative."""
    atol: np.ndarray
    """Tolerated absolute error of each derivative."""
    allow_zero: np.ndarray | None
    """Whether each input may have no effect; None: such inputs cause a warning."""
    seed: int
    horizons: tuple[int, ...]

    def tolerated(self, index: Any, slopes: Any) -> Any:
        """Return the largest errors of slopes by inputs that only cause a warning."""
        return self.atol[index] + self.rtol[index] * np.abs(slopes)

    @property
    def sigmas(self) -> list[float]:
        """The given values of sigma."""
        return [level for level, _ in self.levels]

    def shown(self, level: float) -> str:
        """Return a sigma as text: its smallest and largest standard deviation above 0, or one number where they are the same."""
        each = next((spread[spread > 0] for one, spread in self.levels if one == level), np.array([level]))
        return span(float(each.min()), float(each.max()))

    @property
    def reach(self) -> float:
        """One standard deviation on the lines: the largest sigma, or without one a share of the scale of each input."""
        return max(self.sigmas, default=RELATIVE)


@dataclass(frozen=True)
class JudgedCheck:
    """The check of a gradient at one theta in its four versions, and the measurements that they follow from."""

    layout: ParameterTree
    precision: str
    setup: Setup
    check: Check
    """The gradient check; without parts if it did not finish within the budget."""
    more: Sequence[Check]
    """Checks under further draws of the simulator's own noise."""
    groups: dict[str, GroupSize]
    """By name of a group of numbers that move along one random direction: its size."""
    explained: Explanation
    """Comparisons that explain a wrong gradient."""
    lines: Sequence[LineScan]

    # ------------------------------------------------------------------------------------------------- the versions

    @cached_property
    def judged(self) -> Check:
        """The check with derivatives of a rough cost, or of one with adaptive steps, judged by its smooth part or a refined cost."""
        has_smooth_part = self.explained.wide or (self.explained.steps and self._agrees_with_refined)
        if not has_smooth_part or self.tread or self.is_rough:
            return self.check
        return recaused(self.check, self._of_smooth_part)

    @cached_property
    def named(self) -> Check:
        """The check with the cause of :attr:`hint` as the verdict of wrong derivatives."""
        if self.hint is None:
            return self.judged
        cause = self.hint.cause if self.hint.cause in SUSPICIOUS else "wrong_adjoint"
        return recaused(self.judged, lambda part: replace(part, verdict=cause) if part.verdict in SUSPICIOUS else part)

    @cached_property
    def settled(self) -> Check:
        """The check with tolerated errors counted as right."""
        if self.named.cause not in UNEQUAL:
            return self.named
        return recaused(self.named, lambda part: replace(part, verdict="nonlinear") if self._is_small(part) else part)

    # ------------------------------------------------------------------------------------------------- a rough cost

    def _of_smooth_part(self, part: Part) -> Part:
        """Return a part of a rough cost with the verdict that wide steps, or a refined cost, give.

        Random directions of all numbers and other thetas were compared at tiny steps only, which show nothing there.
        """
        is_open = part.verdict in (*UNEQUAL, "unsettled")
        if part.component is None and part.name not in self.groups:
            return replace(part, verdict="smooth_part") if is_open or part.verdict in rules.BROKEN else part
        can_judge = part.name in self._refined or self.explained.smooth_parts.get(part.name, is_open)
        return self._compared(part) if can_judge and doubtful([part], self.groups) else part

    def _compared(self, part: Part) -> Part:
        """Return a doubtful component or group with the verdict that its slope over wide steps, or of a refined cost, gives."""
        group, is_refined = self.groups.get(part.name), part.name in self._refined
        slope, error = self._slope_of(part)
        # the slope along a random direction may be 0 by chance
        size = max(abs(slope), abs(part.program), group.slope / math.sqrt(group.count) if group else 0.0)
        rtol, atol = (
            (0.0, group.tolerated) if group else (self.setup.rtol[part.component], self.setup.atol[part.component])
        )
        tolerance, apart, doubt = max(float(rtol), resolution(self.unit)), abs(part.program - slope), CLEAR * error
        allowed = tolerance * size + float(atol)
        if not is_refined and error <= allowed and any(o.error > tolerance * abs(o.slope) for o in self.explained.wide):
            error = LOOSE * size  # of one sequence of steps, whose changes other parts show
        is_wrong = apart > error + allowed
        verdicts = [
            ("unsettled", error > LIMIT * size or error < apart - allowed <= doubt),
            # right of one sequence of steps
            ("rounding", is_wrong and part.verdict == "rounding" and part.apart <= 2.0 * part.uncertainty),
            (part.verdict if part.verdict in UNEQUAL else "wrong_adjoint", is_wrong),
            ("smooth_part", error <= allowed or is_refined),
            ("coarse", True),
        ]
        verdict = next(name for name, holds in verdicts if holds)
        return part if verdict == "rounding" else replace(part, verdict=verdict, difference=slope, uncertainty=error)

    def _slope_of(self, part: Part) -> tuple[float, float]:
        """Return the slope of a part by a refined cost, by wide steps, or by tiny steps, and its error."""
        wide, refined = self.explained.smooth_parts.get(part.name), self._refined.get(part.name)
        slope, error = (part.difference, math.inf) if wide is None else (wide.slope, wide.error)
        if refined is None:
            return slope, error
        return refined, min(abs(slope - refined) + error, LOOSE * max(abs(refined), abs(part.program)))

    @cached_property
    def _refined(self) -> dict[str, float]:
        """The refined cost's derivatives by component; empty without a refined cost."""
        slopes = self.explained.refined.components[0, 2] if self.explained.refined else []
        return {p.name: float(one) / p.sample.scale for p, one in zip(self.check.components, slopes, strict=False)}

    @cached_property
    def is_rough(self) -> bool:
        """Whether an unsettled cost varies as much between neighbours as over a wide step, and the gradient does not say so.

        In chaos it does, and is not blamed.
        """
        samples = [p.sample for one in [self.check, *self.more] if one.cause == "unsettled" for p in one.parts]
        return any(
            one.noise > ROUGH * np.abs(one.plus - one.minus)[one.finite].max(initial=0.0)
            and one.noise > max(1e6 * one.unit * abs(one.centre), abs(one.derivative) * FINE * one.scale)
            for one in samples
        )

    @property
    def _agrees_with_refined(self) -> bool:
        """Whether the gradient agrees with a refined cost where the cost's own differences do not, at every theta compared."""
        return bool(self._gaps) and all((gradient <= AGREES * own).all() for gradient, own in self._gaps)

    @cached_property
    def _gaps(self) -> list[np.ndarray]:
        """Distances by theta of gradient and of own differences from a refined cost: by component, and along random directions."""
        return [np.linalg.norm(slopes[:, :2] - slopes[:, 2:], axis=2).T for slopes in self.explained.refined or ()]

    @property
    def tread(self) -> float:
        """Height of the jumps, if all lines have equal, evenly spaced jumps; else 0."""
        treads = [line.tread for line in self.lines] or [0.0]
        return max(treads) if min(treads) > (1 - ALIKE) * max(treads) else 0.0

    # ------------------------------------------------------------------------------------------- causes and tolerances

    @cached_property
    def hint(self) -> Hint | None:
        """The explanation of a wrong gradient that fits its numbers; None without one."""
        return hint_of(self.judged, self.theta, self.explained)

    @cached_property
    def _tolerated(self) -> float:
        """Largest error of a slope along a random direction of components and groups that are all within their tolerance."""
        parts = self.check.components
        sizes = [part.sample.scale * float(self.setup.tolerated(part.component, part.difference)) for part in parts]
        sizes += [group.allowed for group in self.groups.values()]
        return GroupSize(max(len(sizes), 1), float(np.linalg.norm(np.nan_to_num(sizes))), 0.0).tolerated

    def _is_small(self, part: Part) -> bool:
        """Return whether a wrong part's error is within the tolerance."""
        if part.verdict not in UNEQUAL:
            return False
        group = self.groups.get(part.name)
        if part.component is not None:
            allowed = self.setup.tolerated(part.component, part.difference)
        else:
            allowed = group.tolerated if group else max(self._tolerated, self.setup.rtol.max() * abs(part.difference))
        return bool(part.apart <= allowed)

    @property
    def unit(self) -> float:
        """The unit roundoff of the cost's arithmetic."""
        return unit_of(self.precision)

    @property
    def theta(self) -> np.ndarray:
        """The vector ``(d,)``."""
        return self.layout.vector
