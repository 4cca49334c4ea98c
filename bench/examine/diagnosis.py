"""Comparisons that explain a wrong gradient: a refined cost, other numbers of steps, and long lines."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from bench.examine.few import ROUNDS, FewSteps
from bench.examine.lines import LineScan, scan
from bench.examine.stages import GradientStages
from bench.examine.steps import changing_loop
from bench.examine.subspace import choose
from bench.gradient import Check, Part, roughness
from bench.gradient.direction import CHANCE
from bench.gradient.rules import SUSPICIOUS, UNEQUAL
from bench.gradient.smooth_part import COSTS, SmoothPart, smooth_part

NEAR = 0.05
"""Largest relative error of a gradient that small jumps may explain."""
EXPLAINED, EXPLAINED_IF_SMALL = 25.0, 100.0
"""Largest error of a slope that adaptive steps explain, in multiples of the slopes of the breaks on a line: the heights of its
jumps over its length, and its kinks' changes of slope. Of right gradients it reaches 22, since only six breaks of a line are known,
and more where a solver's error is smooth: then it is small."""
FEWEST_BREAKS = 3
"""Fewest breaks on all lines that bound a small error."""
MOST_OF_CHANGE = 0.1
"""Largest height of a jump, as a share of the cost's change along its line, that adaptive steps make: a larger one is an event."""
SPREADS = (0.0, 0.05, 0.1, 0.2, 0.4, 0.8, 0.8)
"""Distances from theta, in units of each input's scale, at which the loops of the program are compared."""
ELSEWHERE, AROUND = 2, 0.05
"""Number of other thetas at which the gradient is compared with a refined cost, and their distance in units of the scales."""
ALONG = 4
"""Random directions of these comparisons at each theta, beside the components."""
LONG = 0.4
"""Distance from theta of the ends of the line on which more breaks are searched, in units of the scales."""
DIFFERENCED, SAME = 4, 1e-3
"""Most components at which differences are compared with a wrong gradient, and the largest part of its error that is left."""
DIFFERENCE_STEPS = 10.0 ** -np.arange(1.0, 9.0)
"""Steps of these differences, in units of max(1, |x|)."""
BESIDE, MOST_ROWS = (1e-5, 1e-4, 1e-3), 64
"""Spacings of the thetas at which the noise of a gradient is measured, in units of each input's scale, and most numbers of it."""
LOOSE, MOST_OF_IT, REFINED = 0.01, 0.6, 10.0
"""Relative error of a difference that shows too little, largest share of the remaining calls for a component's smooth part,
and step of a refined cost's differences, in multiples of the cube root of the unit roundoff: it has a tolerance too."""
SMOOTH = 2
"""Parts along which a cost is not rough that show it smooth, so that no other is searched."""
GROWTH = 1.5
"""Least ratio of errors at the largest and at the first wrong number of steps that counts as growth."""


class Horizon(NamedTuple):
    """The error of a gradient after a number of steps."""

    steps: int
    error: float
    """Largest |gradient - difference|, relative to the largest difference, in units of each input's scale."""
    uncertainty: float
    """The error of the differences, relative to the largest."""
    norm: float
    """Norm of the gradient, in units of each input's scale."""

    def is_wrong(self, tolerance: float) -> bool:
        """Return whether the error is above a tolerance and twice its uncertainty."""
        return self.error > tolerance + 2.0 * self.uncertainty


class RefinedSlopes(NamedTuple):
    """The slopes that gradient, cost and refined cost have at each theta, the given theta first: changes over the scale of an input."""

    components: np.ndarray
    """Along the checked components, ``(1 + ELSEWHERE, 3, m)``."""
    directions: np.ndarray
    """Along random directions of all inputs, since a wrong input may be none of the components."""


@dataclass
class Explanation:
    """What comparisons say about a wrong gradient."""

    is_adaptive: bool | None = None
    """Whether steps that depend on theta explain the error, by the jumps of the cost; None: not compared."""
    steps: str | None = None
    """A loop whose length depends on theta, as ``the loop at ode.py:17``; empty without one, None: not searched."""
    growth: Sequence[Horizon] = ()
    """The error of the gradient by number of steps."""
    smooth_parts: Mapping[str, SmoothPart | None] = field(default_factory=dict)
    """By the name of a part whose differences disagree with the gradient, or hardly agree: the slope of a rough cost's smooth
    part; None where the cost is not rough."""
    refined: RefinedSlopes | None = None
    gradient_noise: float = 0.0
    """Noise of the gradient between neighbouring thetas, relative to its norm."""
    difference_step: str = ""
    """The step at which a difference of the cost is the gradient, ``1e-04 max(1, |x|), forward``; empty without one."""

    @property
    def wide(self) -> list[SmoothPart]:
        """The known slopes of a rough cost's smooth part; empty for a cost that is not rough."""
        return [one for one in self.smooth_parts.values() if one is not None]


def refined_slopes(stages: GradientStages, refined: Callable[..., Any]) -> RefinedSlopes:
    """Return the slopes of gradient, cost and refined cost at theta and :data:`ELSEWHERE`."""
    other = stages.simulator.variant(refined, name="refined")
    random, eps = np.random.default_rng([stages.seed, 0x676170]), float(np.cbrt(stages.simulator.unit))
    components = np.stack([_unit_vector(stages, part) for part in stages.check.components], axis=1)
    around = random.standard_normal((stages.theta.size, min(ALONG, stages.theta.size)))
    vectors = stages.scale[:, None] * np.hstack([components, around / np.linalg.norm(around, axis=0)])
    rows = []
    for spread in (0.0, *[AROUND] * ELSEWHERE):
        theta = stages.theta + spread * stages.scale * random.standard_normal(stages.theta.size)
        slopes = [stages.gradients(theta[:, None])[:, 0] @ vectors]
        for step, one in ((eps, stages.simulator), (REFINED * eps, other)):
            sides = theta[:, None] + step * np.concatenate([vectors, -vectors], axis=1)
            slopes.append(np.subtract(*np.split(stages.costs(sides, simulator=one), 2)) / (2.0 * step))
        rows.append(slopes)
    return RefinedSlopes(*np.split(np.array(rows), [components.shape[1]], axis=2))


def changing_steps(stages: GradientStages) -> str:
    """Return a loop of the cost whose length depends on theta, as ``the loop at ode.py:17``; empty where none is known."""
    random = np.random.default_rng([stages.seed, 0x6C6F6F70])
    moved = np.outer(stages.scale, SPREADS) * random.standard_normal((stages.theta.size, len(SPREADS)))
    return changing_loop(stages.simulator, stages.theta[:, None] + moved, stages.w)


def errors_by_horizon(stages: GradientStages, horizons: Sequence[int]) -> list[Horizon]:
    """Return the error of the gradient after each number of steps, from few differences."""
    result = []
    simulator = stages.simulator
    for steps in sorted(horizons):
        other = simulator.with_steps(steps)
        gradient = other.gradients(stages.theta[:, None], stages.w)[:, 0]
        space = choose(stages.layout, stages.scale, gradient, stages.seed, most=4)
        costs = partial(stages.costs, simulator=other)
        quick = FewSteps(
            space, costs, gradient, float(costs(stages.theta[:, None])[0]), simulator.unit, stages.repeats.spread
        )
        quick.run_round(ROUNDS[0], other.width)
        numbers = [(part.program, part.difference, part.uncertainty) for part in quick.check().parts]
        program, differences, doubts = np.array(numbers).T * space.scale
        size = float(np.abs(differences).max()) or 1.0
        norm = float(np.linalg.norm(gradient * stages.scale))
        error = float(np.abs(program - differences).max() / size)
        result.append(Horizon(steps, error, float(doubts.max() / size), norm))
    return result


def doubtful(parts: Iterable[Part], groups: Collection[str]) -> list[Part]:
    """Return components and groups that a rough cost may spoil: unequal, unsettled, or known to a hundredth only."""
    return [
        part
        for part in parts
        if (part.component is not None or part.name in groups)
        and (
            part.verdict in (*UNEQUAL, "unsettled")
            or (part.verdict == "rounding" and CHANCE * part.uncertainty > LOOSE * abs(part.difference))
        )
    ]


def smooth_parts(stages: GradientStages) -> dict[str, SmoothPart | None]:
    """Return by name the slope of a rough cost's smooth part, for the doubtful parts that the budget allows."""
    random, found = np.random.default_rng([stages.seed, 0x776964]), dict[str, SmoothPart | None]()
    for part in doubtful(stages.check.parts, stages.groups):
        if list(found.values()).count(None) == SMOOTH:
            found[part.name] = None
        elif stages.clock.can_afford(COSTS, share=MOST_OF_IT):
            along = partial(stages.costs_along, _unit_vector(stages, part))
            found[part.name] = smooth_part(along, part.sample.scale, stages.simulator.unit, random)
    return found


@np.errstate(all="ignore")
def noise_of_gradient(stages: GradientStages) -> float:
    """Return the noise of the gradient at thetas along a random direction, at the least spacing at which it always changes, relative to its norm."""
    random = np.random.default_rng([stages.seed, 0x6E6F6973])
    along = stages.scale * random.standard_normal(stages.theta.size)
    for spacing in BESIDE:
        thetas = stages.theta[:, None] + spacing * along[:, None] * np.arange(roughness.POINTS)
        gradients = stages.gradients(thetas)[:MOST_ROWS]
        if np.diff(gradients).any(axis=0).all():
            break
    noise = [roughness.noise(row[None]) for row in gradients]
    return float(np.linalg.norm(noise) / np.linalg.norm(gradients[:, 0]))


@np.errstate(all="ignore")
def step_of_difference(stages: GradientStages) -> str:
    """Return the step at which a difference of the cost is the wrong gradient, ``1e-04 max(1, |x|), forward``; empty where none is.

    A gradient by differences with too long or too short a step is off by the error of that step.
    """
    wrong = [part for part in stages.check.components if part.verdict in SUSPICIOUS][:DIFFERENCED]
    is_same = np.full((2, DIFFERENCE_STEPS.size), bool(wrong))
    for part in wrong:
        steps = max(abs(float(stages.theta[part.component or 0])), 1.0) * DIFFERENCE_STEPS
        costs = stages.costs_along(_unit_vector(stages, part), np.r_[-steps, steps])
        minus, plus = np.split(costs, 2)
        slopes = np.stack([(plus - stages.value) / steps, (plus - minus) / (2 * steps)])
        is_same &= np.abs(slopes - part.program) <= SAME * part.apart
    for name, row in zip(("forward", "central"), is_same, strict=True):
        if row.any():
            return f"{DIFFERENCE_STEPS[int(np.argmax(row))]:.0e} max(1, |x|), {name}"
    return ""


@np.errstate(all="ignore")
def relative_error(outcome: Check) -> float:
    """Return the norm of gradient minus differences over that of the differences, in units of each input's scale.

    A discretisation changes all components by an amount of one size, which is large beside a small component.
    """
    rows = [np.array([p.apart, p.difference]) * p.sample.scale for p in outcome.parts]
    errors, slopes = np.array([row for row in rows if np.isfinite(row).all()]).reshape(-1, 2).T
    return float(np.linalg.norm(errors) / np.linalg.norm(slopes))


def may_be_adaptive(outcome: Check) -> bool:
    """Return whether a gradient is wrong by so little that adaptive steps may be the reason."""
    return outcome.cause in SUSPICIOUS and relative_error(outcome) <= NEAR


def is_adaptive(stages: GradientStages, lines: Sequence[LineScan], effort: tuple[int, int, int]) -> bool:
    """Return whether the breaks of the cost explain the error of the gradient, as with adaptive steps.

    A solver with adaptive steps has another discretisation error on either side of each change of its sequence of steps: its
    cost jumps where a step is rejected, and has a kink where a limit of the steps' sizes is met. Slopes between breaks differ
    from the solution's slopes by about as much as breaks change them. Reverse mode holds the steps fixed, and sensitivities
    or an adjoint have steps of their own, so these gradients differ from differences by as much. Where the lines at theta show
    less, a long line along the error is searched, as :func:`scan` does with ``effort``.
    """
    error = _error_vector(stages)
    size = float(np.linalg.norm(error / stages.scale))
    if not 0.0 < size < np.inf:
        return False
    if size <= EXPLAINED * _breaks_of_steps(lines, stages.scale)[1]:
        return True
    direction, noise = error / size, max(stages.check.noise, stages.repeats.spread)
    line = scan(partial(stages.costs_along, direction), direction, noise, LONG, effort, stages.simulator.unit)
    count, slope = _breaks_of_steps([*lines, line], stages.scale)
    wrong = [part.error for part in stages.check.components if part.verdict in SUSPICIOUS]
    is_small = max(relative_error(stages.check), *wrong) <= NEAR
    if is_small and count < FEWEST_BREAKS:
        return True  # so few breaks do not bound what the others change
    return size <= (EXPLAINED_IF_SMALL if is_small else EXPLAINED) * slope


def _error_vector(stages: GradientStages) -> np.ndarray:
    """Return the displacement ``(d,)`` along which the gradient is most wrong, whose length in the scales is the error there."""
    parts = [part for part in stages.check.parts if part.component is not None or part.name in stages.groups]
    errors = ((p.program - p.difference) * p.sample.scale**2 * _unit_vector(stages, p) for p in parts)
    return sum(errors, np.zeros(stages.theta.size))


def _unit_vector(stages: GradientStages, part: Part) -> np.ndarray:
    """Return the change of theta ``(d,)`` where the coordinate of a component or group changes by 1."""
    vector = np.zeros(stages.theta.size)
    if part.component is not None:
        vector[part.component] = 1.0
    else:
        group = stages.groups[part.name]
        vector[group.first : group.last] = group.vector
    return vector


def _breaks_of_steps(lines: Sequence[LineScan], scale: np.ndarray) -> tuple[int, float]:
    """Return the number of kinks, and of jumps that a solver's steps make, and the largest slope of a line's in units of the scales.

    It is the sum of the jumps over the length of the line, and of the kinks' changes of slope.
    """
    count, slopes = 0, [0.0]
    for line in lines:
        most = MOST_OF_CHANGE * np.abs(np.diff(line.costs)).sum()
        kinks = [one.size for one in line.breaks if one.kind == "kink"]
        jumps = [one.size for one in line.jumps if one.size <= most]
        count += len(kinks) + len(jumps)
        slopes.append(float((sum(jumps) / np.ptp(line.at) + sum(kinks)) / np.linalg.norm(line.direction / scale)))
    return count, max(slopes)
