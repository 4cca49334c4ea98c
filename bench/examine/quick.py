"""Compares a gradient with few differences per component: the first, cheapest stage of an examination.

One step needs two costs per component. The one-sided slopes at the same step differ by h f'' where the cost is smooth and
by a constant at a kink, so half of their difference bounds the error of the central difference, whose own error is of
order h^2 (Nocedal and Wright 2006, section 8.1). Further steps replace this bound by the agreement between steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bench.measure.gradcheck import Check, Part, Sample, most_severe
from bench.measure.gradcheck.causes import Ratio, causes_of_ratios

ROUNDS = (1.0, 30.0, 0.1)
"""Steps of the rounds, in multiples of the cube root of the unit roundoff, at which rounding and curvature balance."""
ROUNDED = 16.0
"""Allowed rounding error of a cost, in unit roundoffs."""
CLEAR = 2.0
"""Least distance of a wrong derivative from the difference, in multiples of the difference's uncertainty."""
SETTLED = 0.1
"""Largest uncertainty of a difference that decides, relative to the derivative."""
SHRINKS = 0.5
"""Largest ratio of the bounds at two steps, ten times apart or more, at which a cost counts as smooth."""
FLOOR = 4.0
"""Allowed non-repeatability of a cost, in multiples of the largest difference seen between equal calls."""


class QuickCheck:
    """Differences of a cost at one to three steps per coordinate. Each finished difference is kept."""

    def __init__(
        self,
        cost: Callable[[np.ndarray], np.ndarray],
        theta: np.ndarray,
        scale: np.ndarray,
        gradient: np.ndarray | None,
        centre: float,
        unit: float,
        floor: float = 0.0,
    ) -> None:
        self._cost, self.theta, self.scale, self.centre = cost, theta, scale, centre
        self.gradient, self.unit, self.floor = gradient, unit, floor
        self.rounds = 0
        """Number of finished rounds."""
        self._values: list[list[tuple[float, float, float]]] = [[] for _ in range(theta.size)]

    def run_round(self, width: int = 1) -> None:
        """Compute two costs per coordinate at the next step, at most ``width`` coordinates per call."""
        eps = ROUNDS[self.rounds] * float(np.cbrt(self.unit))
        for first in range(0, self.theta.size, max(width // 2, 1)):
            chosen = np.arange(first, min(first + max(width // 2, 1), self.theta.size))
            moved = np.repeat(self.theta[:, None], 2 * chosen.size, axis=1)
            steps = eps * self.scale[chosen]
            moved[chosen, np.arange(chosen.size)] -= steps
            moved[chosen, chosen.size + np.arange(chosen.size)] += steps
            costs = self._cost(moved)
            for k, index in enumerate(chosen):
                self._values[index].append((float(steps[k]), float(costs[k]), float(costs[chosen.size + k])))
        self.rounds += 1

    def check(self, names: list[str]) -> Check | None:
        """Return the outcome for the coordinates with at least one difference; None if there are none."""
        parts = [self._part(i, names[i]) for i, values in enumerate(self._values) if values]
        if not parts:
            return None
        wrong = {p.component: [_ratio(p)] for p in parts if p.verdict == "wrong_adjoint" and p.component is not None}
        if wrong:
            causes = causes_of_ratios(wrong, [], any(p.verdict == "smooth" for p in parts))
            if set(causes.values()) == {"wrong_factor"}:
                parts = [_renamed(p, "wrong_factor") if p.component in wrong else p for p in parts]
        gradient = np.full(self.theta.size, np.nan) if self.gradient is None else self.gradient
        size = abs(self.centre)
        return Check(
            cause=most_severe(part.verdict for part in parts),
            theta=self.theta,
            gradient=gradient,
            scale=self.scale,
            parts=tuple(parts),
            draws=(),
            noise=self.floor,
            roundoff=max(self.unit, self.floor / size if size else 0.0),
            order=float("nan"),
            evaluations=2 * sum(len(values) for values in self._values),
            gradients=0,
        )

    def _part(self, index: int, name: str) -> Part:
        step, minus, plus = (np.array(column) for column in zip(*self._values[index], strict=True))
        order = np.argsort(-step)
        step, minus, plus = step[order], minus[order], plus[order]
        with np.errstate(all="ignore"):
            differences = (plus - minus) / (2 * step)
            left, right = (self.centre - minus) / step, (plus - self.centre) / step
            costs = np.maximum(np.maximum(np.abs(minus), np.abs(plus)), abs(self.centre))
            slopes = np.maximum(np.abs(left), np.abs(right))
            noise = (ROUNDED * self.unit * (costs + slopes * self.scale[index]) + FLOOR * self.floor) / step
            bounds = np.abs(right - left) / 2 + noise
        best = int(np.nanargmin(np.where(np.isfinite(bounds), bounds, np.inf)))
        difference, uncertainty = float(differences[best]), float(bounds[best])
        others = np.abs(np.delete(differences, best) - difference)
        # at a kink central differences agree, and the bounds do not shrink with the step
        shrinks = bool(bounds[best] <= SHRINKS * np.max(bounds, initial=0.0, where=np.isfinite(bounds)))
        if others.size and np.isfinite(others).all() and shrinks:
            uncertainty = min(uncertainty, float(others.min() + noise[best]))
        program = difference if self.gradient is None else float(self.gradient[index])
        sample = Sample(step, minus, self.centre, plus, program, np.zeros(step.size, bool), scale=float(self.scale[index]),
                        unit=self.unit, noise=self.floor)  # fmt: skip
        verdict = self._judge(program, difference, uncertainty, differences, bounds, is_nothing(sample))
        return Part(name, index, program, difference, uncertainty, float(step[best]), float(left[best]), float(right[best]),
                    float("nan"), verdict, sample)  # fmt: skip

    def _judge(
        self,
        program: float,
        difference: float,
        uncertainty: float,
        differences: np.ndarray,
        bounds: np.ndarray,
        is_zero: bool,
    ) -> str:
        if not np.isfinite(self.centre) or not np.isfinite(differences).any():
            return "nonfinite"
        if not np.isfinite(program):
            return "nan_gradient"
        if is_zero:
            return "zero"
        size = max(abs(program), abs(difference))
        apart = abs(program - difference)
        contradicted = np.abs(differences - difference) > bounds + uncertainty
        if contradicted.any():
            return "unsettled"
        if apart > CLEAR * uncertainty and apart > float(np.cbrt(self.unit)) * size:
            return "disconnected" if program == 0.0 else "wrong_adjoint"
        return "smooth" if uncertainty <= SETTLED * size else "unsettled"


def is_nothing(sample: Sample) -> bool:
    """Return whether a cost does not move, and its derivative is 0 or changes it by less than its rounding.

    The derivative's change is that over the whole scale of the input.
    """
    is_still = ((sample.minus == sample.centre) & (sample.plus == sample.centre)).all()
    return bool(is_still and abs(sample.derivative) * sample.scale <= ROUNDED * sample.unit * abs(sample.centre))


def _ratio(part: Part) -> Ratio:
    size = abs(part.difference)
    return Ratio(part.ratio, abs(part.ratio) * part.uncertainty / size if size > 0.0 else 0.0)


def _renamed(part: Part, verdict: str) -> Part:
    return replace(part, verdict=verdict)
