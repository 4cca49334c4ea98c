"""Compares a gradient with differences at one to three steps per coordinate: the first, cheapest stage of an examination.

One step needs two costs per coordinate. The one-sided slopes at the same step differ by h f'' where the cost is smooth and
by a constant at a kink, so half of their difference bounds the error of the central difference, whose own error is of
order h^2 (Nocedal and Wright 2006, section 8.1). Further steps replace this bound by the agreement between steps.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, replace

import numpy as np

from bench.examine.subspace import Subspace
from bench.gradient.check import NOTHING, Check, Part, cause_of
from bench.gradient.direction import ALIKE, MEASURED, Function, Sample, finding_at, resolution, wrong

ROUNDS = (1.0, 30.0, 0.1)
"""Steps of the rounds, in multiples of the cube root of the unit roundoff, at which rounding and curvature balance."""
ROUNDED = 16.0
"""Allowed rounding error of a cost, in unit roundoffs."""
CLEAR = 2.0
"""Least distance of a wrong derivative from the difference, in multiples of the difference's uncertainty."""
SHRINKS = 0.5
"""Largest ratio of the bounds at two steps, ten times apart or more, at which a cost counts as smooth."""
FLOOR = 4.0
"""Allowed non-repeatability of a cost, in multiples of the largest difference seen between equal calls."""


@dataclass
class FewSteps:
    """Differences of a cost at one to three steps per coordinate of a space. Each finished difference is kept."""

    space: Subspace
    cost: Function
    """The cost, ``(d, B)`` to ``(B,)``."""
    gradient: np.ndarray | None
    """The gradient by theta, ``(d,)``."""
    centre: float
    """The cost at theta."""
    unit: float
    floor: float = 0.0
    """Largest difference between equal calls of the cost."""
    values: dict[int, list[tuple[float, float, float]]] = field(default_factory=lambda: defaultdict(list))
    """Step and costs on both sides, by coordinate."""

    def run_round(self, step: float, width: int = 1) -> None:
        """Compute two costs per coordinate at one of :data:`ROUNDS`, at most ``width`` costs per call."""
        steps, size = step * float(np.cbrt(self.unit)) * self.space.scale, self.space.size
        for chosen in np.array_split(np.arange(size), -(-size // max(width // 2, 1))):
            moved = np.zeros((size, 2 * chosen.size))
            moved[np.tile(chosen, 2), np.arange(2 * chosen.size)] = np.r_[-steps[chosen], steps[chosen]]
            costs = self.cost(self.space.place(moved)).reshape(2, -1)
            for index, minus, plus in zip(chosen, *costs, strict=True):
                self.values[int(index)].append((float(steps[index]), float(minus), float(plus)))

    def check(self) -> Check:
        """Return the outcome for the coordinates with at least one difference."""
        gradient = np.full(self.space.size, np.nan) if self.gradient is None else self.space.project(self.gradient)
        parts = [self._part(i, float(gradient[i])) for i in sorted(self.values)]
        if not parts:
            return NOTHING
        return self.space.restore(Check(cause_of(parts), tuple(parts), ()))

    @np.errstate(all="ignore")
    def _part(self, index: int, program: float) -> Part:
        step, minus, plus = np.array(sorted(self.values[index], reverse=True)).T
        sample = Sample(
            step,
            minus,
            self.centre,
            plus,
            program,
            np.zeros(step.size, bool),
            scale=float(self.space.scale[index]),
            unit=self.unit,
            noise=self.floor,
        )
        noise = ROUNDED / MEASURED * sample.rounding(self.unit) + FLOOR * self.floor / step
        bounds = np.abs(sample.right - sample.left) / 2 + noise
        finite = np.isfinite(bounds)
        best = int(np.argmin(np.where(finite, bounds, np.inf)))
        difference, uncertainty = float(sample.differences[best]), float(bounds[best])
        others = np.abs(np.delete(sample.differences, best) - difference)
        # at a kink central differences agree, and the bounds do not shrink with the step
        shrinks = bounds[best] <= SHRINKS * np.max(bounds, initial=0.0, where=finite)
        if others.size and np.isfinite(others).all() and shrinks:
            uncertainty = min(uncertainty, float(others.min() + noise[best]))
        if self.gradient is None:
            sample = replace(sample, derivative=difference)
        # in chaos, slopes at smaller steps bend by more than the slope
        is_bent = (bounds - 2.0 * noise)[best + 1 :] > abs(difference) + uncertainty
        is_contradicted = bool((np.abs(sample.differences - difference) > bounds + uncertainty).any() or is_bent.any())
        finding = finding_at(sample, _judge(sample, difference, uncertainty, is_contradicted), best, uncertainty)
        return Part(name=f"component {index}", component=index, sample=sample, **vars(finding))


def _judge(sample: Sample, difference: float, uncertainty: float, is_contradicted: bool) -> str:
    program = sample.derivative
    size, apart = max(abs(program), abs(difference)), abs(program - difference)
    if not np.isfinite(sample.centre) or not np.isfinite(sample.differences).any():
        return "nonfinite"
    if not np.isfinite(program):
        return "nan_gradient"
    if is_nothing(sample):
        return "zero"
    if is_contradicted:
        return "unsettled"
    if apart > CLEAR * uncertainty and apart > resolution(sample.unit) * size:
        return wrong(sample)
    return "smooth" if uncertainty <= ALIKE * size else "unsettled"


def is_nothing(sample: Sample) -> bool:
    """Return whether a cost does not move, and its derivative is 0 or changes it by less than its rounding.

    The derivative's change is that over the whole scale of the input.
    """
    is_still = ((sample.minus == sample.centre) & (sample.plus == sample.centre)).all()
    return bool(is_still and abs(sample.derivative) * sample.scale <= ROUNDED * sample.unit * abs(sample.centre))
