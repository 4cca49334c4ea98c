"""Comparisons that explain a wrong gradient: a refined cost, other numbers of steps, and long lines."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

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
from bench.simulator.simulator import Simulator

NEAR = 0.05
"""Largest relative error of a gradient that small jumps may explain."""
FAR, FAR_JUMPS = 0.25, 0.5
"""Largest relative error that larger jumps may explain, and their largest total height, as a share of the cost's change."""
EXPLAINED = 30.0
"""Largest error of a gradient on a line, in multiples of the jumps' total height over the length of the line. An adjoint that is
solved separately reaches 25, since only the six largest jumps of a line are known."""
SMALL_JUMPS = 0.05
"""Largest total height of such jumps, as a share of the cost's change along the line."""
FEWEST_JUMPS = 2
"""Fewest jumps on the lines that count as jumps of adaptive steps."""
SPREADS = (0.0, 0.05, 0.1, 0.2, 0.4)
"""Distances from theta, in units of each input's scale, at which the loops of the program are compared."""
ELSEWHERE, AROUND = 2, 0.05
"""Number of other thetas at which the gradient is compared with a refined cost, and their distance in units of the scales."""
ALONG = 4
"""Random directions of these comparisons at each theta, beside the components."""
LONGER = 10.0
"""Length of the line on which more jumps are searched, in multiples of the first line."""
DIFFERENCED, SAME = 4, 1e-3
"""Most components at which differences are compared with a wrong gradient, and the largest part of its error that is left."""
DIFFERENCE_STEPS = 10.0 ** -np.arange(1.0, 9.0)
"""Steps of these differences."""
BESIDE, MOST_ROWS = 1e-3, 64
"""Spacing of the thetas at which the noise of a gradient is measured, in units of each input's scale, and most numbers of it."""
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
    refined: np.ndarray | None = None
    """The slopes of :func:`refined_slopes`; None without a refined cost."""
    gradient_noise: float = 0.0
    """Noise of the gradient between neighbouring thetas, relative to its norm."""
    difference_step: str = ""
    """The step at which a difference of the cost is the gradient, ``1e-4, forward``; empty without one."""

    @property
    def wide(self) -> list[SmoothPart]:
        """The known slopes of a rough cost's smooth part; empty for a cost that is not rough."""
        return [one for one in self.smooth_parts.values() if one is not None]


def refined_slopes(stages: GradientStages, other: Simulator) -> np.ndarray:
    """Return by theta the slopes that gradient, cost and refined cost have, ``(1 + ELSEWHERE, 3, m)``, theta first.

    They are along the checked components, and then along random directions of all inputs. A slope is the change over the
    scale of an input.
    """
    index = [part.component or 0 for part in stages.check.components]
    random, eps = np.random.default_rng([stages.seed, 0x676170]), float(np.cbrt(stages.simulator.unit))
    vectors = np.zeros((stages.theta.size, len(index) + min(ALONG, stages.theta.size)))
    vectors[index, np.arange(len(index))] = 1.0
    around = random.standard_normal(vectors[:, len(index) :].shape)
    vectors[:, len(index) :] = around / np.linalg.norm(around, axis=0)
    vectors *= stages.scale[:, None]
    rows = []
    for spread in (0.0, *[AROUND] * ELSEWHERE):
        theta = stages.theta + spread * stages.scale * random.standard_normal(stages.theta.size)
        own, exact = (
            stages.differences(theta, vectors, step, one)
            for step, one in ((eps, stages.simulator), (REFINED * eps, other))
        )
        rows.append([stages.gradient_at(theta) @ vectors, own, exact])
    return np.array(rows)


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

        def costs(thetas: np.ndarray, other: Simulator = other) -> np.ndarray:
            return other.costs(thetas, stages.same_noise(thetas.shape[1]))

        quick = FewSteps(
            space, costs, gradient, float(costs(stages.theta[:, None])[0]), simulator.unit, stages.repeats.spread
        )
        quick.run_round(ROUNDS[0], other.width)
        outcome = quick.check()
        if not outcome.parts:
            continue
        numbers = [(part.program, part.difference, part.uncertainty) for part in outcome.parts]
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


def smooth_parts(stages: GradientStages, outcome: Check) -> dict[str, SmoothPart | None]:
    """Return by name the slope of a rough cost's smooth part, for the doubtful parts that the budget allows."""
    random, found = np.random.default_rng([stages.seed, 0x776964]), dict[str, SmoothPart | None]()
    groups = {group.name: group for group in stages.groups}
    for part in doubtful(outcome.parts, groups):
        if list(found.values()).count(None) == SMOOTH:
            found[part.name] = None
        elif stages.clock.can_afford(COSTS, share=MOST_OF_IT):
            direction, group = np.zeros(stages.theta.size), groups.get(part.name)
            if group is None:
                direction[part.component or 0] = 1.0
            else:
                direction[group.first : group.last] = group.vector
            along = partial(stages.costs_along, direction)
            found[part.name] = smooth_part(along, part.sample.scale, stages.simulator.unit, random)
    return found


@np.errstate(all="ignore")
def noise_of_gradient(stages: GradientStages) -> float:
    """Return the noise of the gradient at equally spaced thetas along a random direction, relative to its norm."""
    random = np.random.default_rng([stages.seed, 0x6E6F6973])
    along = BESIDE * stages.scale * random.standard_normal(stages.theta.size)
    thetas = stages.theta[:, None] + along[:, None] * np.arange(roughness.POINTS)
    gradients = np.stack([stages.gradient_at(theta) for theta in thetas.T], axis=1)
    noise = [roughness.noise(row[None]) for row in gradients[:MOST_ROWS]]
    return float(np.linalg.norm(noise) / np.linalg.norm(gradients[:MOST_ROWS, 0]))


@np.errstate(all="ignore")
def step_of_difference(stages: GradientStages, outcome: Check) -> str:
    """Return the step at which a difference of the cost is the wrong gradient, ``1e-4, forward``; empty where none is.

    A gradient by differences with too long or too short a step is off by the error of that step.
    """
    wrong = [part for part in outcome.components if part.verdict in SUSPICIOUS][:DIFFERENCED]
    if not wrong:
        return ""
    program = np.array([part.program for part in wrong])
    allowed = SAME * np.abs(program - [part.difference for part in wrong])
    index = [part.component or 0 for part in wrong]
    at = np.abs(stages.theta[index])
    for size, units in (("", np.ones_like(at)), (" max(1, |x|)", np.maximum(at, 1.0)), (" |x|", at)):
        steps = units[:, None] * DIFFERENCE_STEPS
        moved = np.zeros((stages.theta.size, 2, *steps.shape))
        moved[index, :, np.arange(len(index))] = np.stack([-steps, steps], axis=1)
        thetas = stages.theta[:, None] + moved.reshape(stages.theta.size, -1)
        minus, plus = stages.costs(thetas).reshape(2, *steps.shape)
        for name, slopes in (("forward", (plus - stages.value) / steps), ("central", (plus - minus) / (2 * steps))):
            is_same = (np.abs(slopes - program[:, None]) <= allowed[:, None]).all(axis=0)
            if is_same.any():
                return f"{DIFFERENCE_STEPS[int(np.argmax(is_same))]:.0e}{size}, {name}"
    return ""


def grows(horizons: Sequence[Horizon], tolerance: float) -> bool:
    """Return whether the gradient is right after few steps and its error grows with the number of steps."""
    wrong = [one for one in horizons if one.is_wrong(tolerance)]
    if len(horizons) < 2 or not wrong or horizons[0] in wrong:
        return False
    last = horizons[-1]
    return last in wrong and (len(wrong) == 1 or last.error > GROWTH * wrong[0].error)


@np.errstate(all="ignore")
def relative_error(outcome: Check) -> float:
    """Return the norm of gradient minus differences over that of the differences, in units of each input's scale.

    A discretisation changes all components by an amount of one size, which is large beside a small component.
    """
    parts = [part for part in outcome.parts if np.isfinite([part.program, part.difference]).all()]
    single = [(p.program, p.difference, p.sample.scale) for p in parts if p.component is not None]
    program, differences, scale = np.array(single).reshape(-1, 3).T
    size = float(np.linalg.norm(differences * scale))
    errors = [(float(np.linalg.norm(program * scale - differences * scale)), size)]
    # a group or a direction has length 1 in these units
    errors += [(abs(p.program - p.difference), max(abs(p.difference), size)) for p in parts if p.component is None]
    return max(error / size if size > 0 else float("inf") for error, size in errors)


def may_be_adaptive(outcome: Check) -> bool:
    """Return whether a gradient is wrong by so little that adaptive steps may be the reason."""
    return outcome.cause in SUSPICIOUS and relative_error(outcome) <= NEAR


def is_adaptive(
    stages: GradientStages, outcome: Check, lines: Sequence[LineScan], effort: tuple[int, int, int]
) -> bool:
    """Return whether the jumps of the cost explain the error of the gradient, as with adaptive steps.

    A solver with adaptive steps has another discretisation error on either side of each change of its number of steps.
    Its cost has a small jump there, and slopes between jumps that differ from the solution's slopes by about the height
    of a jump over the distance between jumps. Reverse mode through such a solver holds the steps fixed, and an adjoint
    that is solved separately has steps of its own, so these gradients differ by as much. Where few jumps are found
    beside a small error, a line ten times as long is searched, as :func:`scan` does with ``effort``. A larger error
    counts where the jumps on the first lines change the cost by more than the error does.
    """
    lines = [line for line in lines if np.isfinite(line.costs).all()]
    error = relative_error(outcome)
    if stages.gradient is None or not lines or error > FAR:
        return False

    if sum(len(line.jumps) for line in lines) < FEWEST_JUMPS and error <= NEAR:
        first, noise = lines[0], max(outcome.noise, stages.repeats.spread)
        reach, unit = LONGER * float(first.at[-1]), stages.simulator.unit
        cost = partial(stages.costs_along, first.direction)
        lines = [scan(cost, first.direction, noise, reach, effort, unit)]
    if sum(len(line.jumps) for line in lines) < FEWEST_JUMPS:
        return False
    rows = []
    for line in lines:
        step = 1e-3 * float(line.at[1] - line.at[0])
        slope = stages.differences(stages.theta, line.direction[:, None], step)
        apart = abs(float(slope[0] - line.direction @ stages.gradient))
        rows.append((sum(jump.size for jump in line.jumps), np.abs(np.diff(line.costs)).sum(), apart * np.ptp(line.at)))
    heights, changes, errors = np.array(rows).T
    is_near = error <= NEAR and ((heights < SMALL_JUMPS * changes) & (errors <= EXPLAINED * heights)).any()
    is_far = heights.sum() < FAR_JUMPS * changes.sum() and (errors <= heights).all()
    return bool(is_near or is_far)
