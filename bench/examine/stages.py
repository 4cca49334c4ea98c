"""The stages of a gradient check: what decides comes first, and each finished stage is kept when the next is cut off.

1. The cost and its gradient at theta, once.
2. Two costs per component, at one step: enough to detect a gradient that is 10% off.
3. Repeated calls, which show whether the cost repeats and whether it depends on the call before.
4. Nine steps per component, then all steps with random directions, then other thetas.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from bench.examine.few import ROUNDS, FewSteps, is_nothing
from bench.examine.subspace import Group, Subspace, choose, count_of, in_parts, locate
from bench.gradient import EPS, FAULTS, TRUSTED, Check, Options, Part, check, step_sizes
from bench.gradient.check import ELSEWHERE, NOTHING, cause_of
from bench.gradient.direction import Function
from bench.simulator.clock import OutOfTime
from bench.simulator.simulator import Simulator

NOISE_POINTS = 17
"""Costs per direction that no step needs: the centre, and the points at which the noise is measured."""
SCAN = 7 * 65
"""Number of costs of a staircase search along one direction that is not clearly right."""
FEW, MOST = 2, 8
"""Numbers of other thetas of the last stages."""
SMALL = 0.6
"""Power of the unit roundoff: a relative difference between equal calls below it is a floor, not a fault."""
MANY = 10_000
"""Largest theta that is checked at 8 other thetas; a larger one at 2, since each call copies all its numbers."""
OTHER_NOISE = 2
"""Number of further draws of the simulator's own noise under which the gradient is checked along random directions."""
IN_CELL = 0.4
"""Distance from a float32 number, in units of its last place, that float32 rounds away."""
CELLS, DISTINCT_CELLS = 9, 6
"""Number of neighbouring float32 thetas at which costs are compared, and fewest different costs of a cost in float32."""
MOST_OF_IT = 0.9
"""Share of the remaining budget after which a running stage is stopped."""
SHARE = 0.8
"""Largest share of the remaining budget of a stage before the last."""
BEFORE_NOISE = 0.4
"""Largest share of the last stage on a gradient that looks right, where noise is measured after it."""
STATE = 0.1
"""Largest share of the difference between histories by which a cost with equal histories differs."""
CALLS, CALLS_OF_STATE = 8, 26
"""Equal calls of a cost, and those that show a state: noise of two values looks like one in 8 calls once in 8, in 26 once in 30,000."""


@dataclass
class Repeats:
    """How far equal calls differ."""

    spread: float = 0.0
    """Largest difference between equal calls of the cost."""
    of_gradient: float = 0.0
    """Largest difference between equal calls of the gradient, relative to its norm."""
    has_state: bool = False
    """Whether the cost depends on the call before it, in a repeatable way."""
    is_failing: bool = False
    """Whether equal calls raise an exception or return a number."""
    floor: float = 0.0
    """Largest spread that only limits the accuracy of the check."""
    floor_of_gradient: float = 0.0

    @property
    def is_large(self) -> bool:
        """Whether these differences are a fault, and no limit of the check's accuracy."""
        return self.spread > self.floor or self.of_gradient > self.floor_of_gradient


class GradientStages:
    """Checks a simulator's gradient at theta, stage by stage, within the budget of its clock."""

    def __init__(
        self,
        simulator: Simulator,
        scale: np.ndarray,
        seed: int,
        has_noise: bool = False,
    ) -> None:
        self._has_noise = has_noise  # whether noise on theta is measured after the stages
        self.simulator, self.scale, self.clock, self.seed = simulator, scale, simulator.clock, seed
        self.layout, self.theta = simulator.layout, simulator.layout.vector
        self._random = np.random.default_rng([seed, 0x6578616D])
        self.w = self._random.standard_normal((simulator.noise, 1)) if simulator.noise else None
        """The draw of the simulator's own noise, ``(n, 1)``."""
        self.value = math.nan
        self.gradient: np.ndarray | None = None
        """The gradient at theta, ``(d,)``; None without a gradient, or where it failed."""
        self.check = NOTHING
        """The outcome of the last finished stage."""
        self.is_quick = True
        """Whether only few steps per component were checked."""
        self.is_complete = False
        """Whether every chosen component and group was checked."""
        self.is_failed = False
        """Whether the gradient at theta raised an exception."""
        self.more: list[Check] = []
        """Checks under other draws of the simulator's own noise."""
        self.located: dict[str, tuple[int, int]] = {}
        """By name of a wrong group: the first of the numbers that cause its error, and the last + 1."""
        self.groups: dict[str, Group] = {}
        """By name: the groups of a large theta that are checked along one direction each."""
        self.left_out: list[str] = []
        self.repeats = Repeats(floor_of_gradient=simulator.unit**SMALL)
        self._repeated = False  # whether calls were repeated within the budget
        self._before: dict[tuple[bytes, ...], Any] = {}
        """Costs and gradients by their coordinates and the draw of the simulator's own noise."""

    # ------------------------------------------------------------------------------------------------ calls

    def costs(self, thetas: np.ndarray, w: np.ndarray | None = None, simulator: Simulator | None = None) -> np.ndarray:
        """Return the costs ``(B,)`` of ``thetas (d, B)``, also of another simulator, all under the same draw of its own noise."""
        return (simulator or self.simulator).costs(thetas, self.same_noise(thetas.shape[1], w))

    def same_noise(self, count: int, w: np.ndarray | None = None) -> np.ndarray | None:
        """Return a draw ``w (n, 1)`` of the simulator's own noise, by default the first, for each of ``count`` thetas."""
        w = self.w if w is None else w
        return None if w is None else np.repeat(w, count, axis=1)

    def costs_along(self, direction: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the costs ``(n,)`` at theta + t * direction for t of n numbers."""
        return self.along(self.costs, direction, t)

    def along(self, function: Function, direction: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return a function of columns, ``(n,)``, at theta + t * direction for t of n numbers."""
        theta, vector = self.theta[:, None], direction[:, None]
        return in_parts(lambda part: function(theta + vector * part), t.ravel(), self.simulator.width)

    def gradients(self, thetas: np.ndarray, w: np.ndarray | None = None) -> np.ndarray:
        """Return the simulator's gradients at ``thetas (d, B)``, all under the same draw of its own noise."""
        return self.simulator.gradients(thetas, self.same_noise(thetas.shape[1], w))

    def _costs_in(self, space: Subspace, w: np.ndarray | None, z: np.ndarray) -> np.ndarray:
        """Return the costs ``(B,)`` at coordinates ``z (m, B)``."""
        costs = in_parts(lambda part: self.costs(space.place(part), w), z, self.simulator.width)
        apart = [self._apart(w, column, cost) for column, cost in zip(z.T, costs, strict=True)]
        self.repeats.spread = max(self.repeats.spread, *apart)
        return costs

    def _gradient_in(self, space: Subspace, w: np.ndarray | None, z: np.ndarray) -> np.ndarray:
        """Return the derivatives by the coordinates of a space at ``z (m,)``, ``(m,)``."""
        gradient = space.project(self.gradients(space.place(z[:, None]), w)[:, 0])
        size = float(np.linalg.norm(gradient))
        apart = self._apart(w, z, gradient) / size if size else 0.0
        self.repeats.of_gradient = max(self.repeats.of_gradient, apart)
        return gradient

    def _apart(self, w: np.ndarray | None, z: np.ndarray, value: Any) -> float:
        """Return by how much a cost or a gradient differs from that of an equal call before; 0 at the first call."""
        key = z.tobytes(), b"" if w is None else w.tobytes(), str(np.ndim(value)).encode()
        return float(np.nan_to_num(np.abs(self._before.setdefault(key, value) - value)).max())

    # ------------------------------------------------------------------------------------------------ stages

    def run(self, explain: Callable[[], None]) -> None:
        """Run all stages that the budget allows; ``explain`` is called where a gradient is wrong, before its cause is named."""
        with self.clock.stage("the gradient check", self.left_out):
            self._start()
        if self.left_out:
            return
        self.repeat_failures()
        if self.is_failed:
            return
        space = choose(self.layout, self.scale, self.gradient, self.seed)
        self.groups = {group.name: group for group in space.groups}
        with self.clock.stage("the check at more than one step", self.left_out):
            for stage in (partial(self._compare_quickly, space), self._repeat):
                stage()
                if self._has_hidden_single():
                    self.simulator.precision = "float32"
                    self._compare_quickly(space)
        if "the check at more than one step" in self.left_out or not self.check.parts:
            return
        self._check_in_stages(space, explain)
        self._locate(space)
        self._check_under_other_noise(space)

    def repeat_failures(self) -> None:
        """Repeat calls that raised an exception, which may do so at random; the repeats do not count as further exceptions."""
        counts = deepcopy(self.simulator.raised)
        with self.clock.stage("calls that raised an exception, once more", self.left_out):
            for kind, *parts in list(self.simulator.failed):
                self.repeats.is_failing |= bool(np.isfinite(getattr(self.simulator, kind)(*parts)).any())
        self.simulator.raised = counts

    def _start(self) -> None:
        """Compute the cost at theta, once more, and the gradient."""
        simulator = self.simulator
        self.value = simulator.first_value
        if simulator.noise or simulator.batch != "loop" or math.isnan(self.value):
            self.value = float(self.costs(self.theta[:, None])[0])
        self.repeats.floor = simulator.unit**SMALL * (abs(self.value) if math.isfinite(self.value) else 0.0)
        if not simulator.has_gradient:
            return
        gradient = self.gradients(self.theta[:, None])[:, 0]
        self.is_failed = bool(simulator.raised["gradients"])
        if not self.is_failed:
            self.gradient = gradient

    def _compare_quickly(self, space: Subspace) -> None:
        """Compare the gradient with two costs per coordinate, and with more where the full steps do not fit."""
        quick = FewSteps(space, self.costs, self.gradient, self.value, self.simulator.unit, self.repeats.spread)
        try:
            for step in ROUNDS:
                quick.run_round(step, self.simulator.width)
                if self.clock.can_afford(*self._cost_of(self._options(space.size), space.size), share=SHARE):
                    break
        finally:
            outcome = quick.check()
            if outcome.parts:
                self.check, self.is_quick = outcome, True
                self.is_complete = len(outcome.parts) == space.size

    def _repeat(self) -> None:
        """Repeat calls, after equal and after other thetas, and compare the results."""
        other, values = self.theta + 1e-3 * self.scale, [self.value]
        with self.clock.stage("repeating a call", self.left_out):
            while len(values) < CALLS or (len(values) < CALLS_OF_STATE and self._compare_calls(values)):
                at = other if len(values) % 3 == 2 else self.theta
                values.append(float(self.costs(at[:, None])[0]))
        self._repeat_gradient(other)
        self._repeated = len(values) >= CALLS
        self.repeats.has_state = self._compare_calls(values) and len(values) == CALLS_OF_STATE

    def _compare_calls(self, values: list[float]) -> bool:
        """Record how far equal calls differ, and return whether they differ by the call before them alone, each time by as much.

        Every third call is at another theta.
        """
        for same in (values[2::3], [*values[::3], *values[1::3]]):
            if len(same) > 1 and np.isfinite(same).all():
                self.repeats.spread = max(self.repeats.spread, float(np.ptp(same)))
        # last digits that vary at random are alike by chance
        if len(values) < CALLS or self.repeats.spread <= self.repeats.floor:
            return False
        after_theta, after_other = values[4::3], values[3::3]
        apart = STATE * abs(after_theta[-1] - after_other[-1])
        return bool(max(np.ptp(after_theta), np.ptp(after_other)) <= apart and apart > 0.0)

    def _repeat_gradient(self, other: np.ndarray) -> None:
        """Compare the gradient with that of an equal call after one at ``other (d,)``, or in a batch with it."""
        if self.gradient is None or not np.isfinite(self.gradient).all():
            return
        with self.clock.stage("repeating a gradient", self.left_out):
            _, again = self.gradients(np.stack([other, self.theta], axis=1)).T
            size = float(np.linalg.norm(self.gradient))
            if size and np.isfinite(again).all():
                self.repeats.of_gradient = float(np.linalg.norm(again - self.gradient)) / size

    def _has_hidden_single(self) -> bool:
        """Return whether a cost that returns float64 computes in float32: its values have single precision, or it reads
        theta as float32.

        A cost that reads theta as float32 is constant within one rounding cell of float32, and changes from each cell to
        the next, unlike a staircase with wider treads.
        """
        if self.simulator.unit > float(np.finfo(np.float64).eps) or self.repeats.spread > 0.0:
            return False
        if self.simulator.has_single_precision:
            return True
        if not self._repeated:
            return False
        with np.errstate(all="ignore"):
            rounded = self.theta.astype(np.float32)
            first, ulp = rounded.astype(np.float64), np.spacing(np.abs(rounded)).astype(np.float64)
        ulp = ulp * np.where(np.arange(first.size) % 3 == 1, -1.0, 1.0)

        def costs(*units: float) -> np.ndarray:
            return self.costs(first[:, None] + ulp[:, None] * np.array(units))

        if np.ptp(costs(0.0, IN_CELL)):
            return False
        cells = costs(*range(CELLS))
        inside = costs(-IN_CELL, CELLS // 2 - IN_CELL, CELLS // 2 + IN_CELL)
        is_constant = cells[0] == inside[0] and cells[CELLS // 2] == inside[1] == inside[2]
        return bool(is_constant and np.unique(cells).size >= DISTINCT_CELLS)

    def _options(self, size: int, draws: int = -1) -> Options:
        """Return the options of the last stage with a number of other thetas, or by default those of more steps."""
        eps, is_right, is_large = step_sizes(self.simulator.unit), self.check.trusted, self.theta.size > MANY
        is_last = draws >= 0
        has_all = is_last and (is_right or is_large or draws != FEW)
        return Options(
            components=size,
            directions=2 * is_last,
            draws=max(draws, 0),
            unit=self.simulator.unit,
            seed=self.seed,
            eps=eps if has_all or eps is not EPS else eps[::2],
            # a wrong gradient is named by its ratios at other thetas first, and then searched for staircases
            scanned=4 if draws == MOST or (is_right and is_last) else 0,
            repeated=is_right and is_last and self.repeats.spread == 0.0,
        )

    def _cost_of(self, options: Options, size: int) -> tuple[int, int]:
        """Return the numbers of costs and gradients of a stage."""
        each = 2 * options.eps.size + NOISE_POINTS
        costs = ((size + options.directions) * (1 + options.repeated) + options.draws * options.directions) * each
        wrong = sum(part.verdict in FAULTS for part in self.check.parts)
        if wrong and options.draws:
            costs += min(ELSEWHERE, options.draws) * wrong * each + 4 * options.draws * each
        unclear = wrong + sum(part.verdict == "rounding" for part in self.check.parts)
        if unclear and options.scanned:
            costs += min(unclear + options.directions, options.scanned) * SCAN
        gradients = 0 if self.gradient is None else 3 + options.draws * (3 if wrong else 1)
        return costs, gradients

    def enough(self) -> tuple[float, float]:
        """Return the numbers of costs and gradients with which every stage finishes, within its share of them."""
        size, share = count_of(self.theta.size), BEFORE_NOISE if self._has_noise else SHARE
        last = self._cost_of(self._options(size, MOST if self.theta.size <= MANY else FEW), size)
        more = self._cost_of(self._options(size), size)
        costs, gradients = (before + one / share for before, one in zip(more, last, strict=True))
        return costs + 2 * len(ROUNDS) * size + NOISE_POINTS, gradients + NOISE_POINTS

    def _check_in_stages(self, space: Subspace, explain: Callable[[], None]) -> None:
        if not self._run_stage("more steps", space, self._options(space.size), SHARE):
            return
        draws = [MOST, FEW, 0] if self.theta.size <= MANY else [FEW, 0]
        is_wrong = any(part.verdict in FAULTS for part in self.check.parts)
        if is_wrong:
            explain()
            draws = draws[
                -2::-1
            ]  # named by few thetas first, so that the name does not depend on the time that is left
        for count in draws:
            share = BEFORE_NOISE if self._has_noise and self.check.trusted else MOST_OF_IT
            name = f"{count} other thetas" if count else "all steps and random directions"
            is_done = self._run_stage(name, space, self._options(space.size, count), share)
            if is_done != is_wrong:
                break

    def _run_stage(self, name: str, space: Subspace, options: Options, share: float) -> bool:
        """Run a stage if it fits a share of the remaining budget, and return whether it has finished."""
        with self.clock.stage(name, self.left_out, MOST_OF_IT):
            if not self.clock.can_afford(*self._cost_of(options, space.size), share=share):
                raise OutOfTime
            self.check, self.is_quick = space.restore(self._check_once(space, options)), False
            return True
        return False

    def _check_once(self, space: Subspace, options: Options, w: np.ndarray | None = None) -> Check:
        outcome = check(
            partial(self._costs_in, space, w),
            None if self.gradient is None else partial(self._gradient_in, space, w),
            np.zeros(space.size),
            replace(options, scale=space.scale),
        )
        is_own = any(part.verdict == "nondeterministic" for part in outcome.parts)
        if is_own and options.repeated and not self.repeats.is_large and self.repeats.spread > 0.0:
            return self._check_once(space, replace(options, repeated=False), w)
        if self.simulator.raised["gradients"]:
            # a gradient that raises at other thetas is reported as such
            draws = tuple(part for part in outcome.draws if np.isfinite(part.program))
            outcome = recaused(replace(outcome, draws=draws))
        outcome = _with_zeros(outcome)
        if outcome.cause == "nondeterministic" and not is_own and not self.repeats.is_large:
            outcome = recaused(outcome)  # only the last digits of the gradient differ
        return outcome

    def _locate(self, space: Subspace) -> None:
        """Find the numbers that cause the error of each wrong group."""
        if self.gradient is None:
            return
        with self.clock.stage("the place of the error in its group", self.left_out):
            for part in self.check.parts:
                if part.name in self.groups and part.verdict in FAULTS and math.isfinite(part.program):
                    first, last = locate(self.groups[part.name], self.theta, self.gradient, self.costs, part)
                    self.located[part.name] = first, last
                    if last - first == 1 and first not in space.components:
                        self._check_number(first, part.verdict)

    def _check_number(self, index: int, verdict: str) -> None:
        """Check a single number of theta, and add it to the check with a verdict if it is wrong.

        Its error is a small part of the slope of its group, which may be within the tolerance.
        """
        space = Subspace(self.layout, self.scale, [index], [])
        quick = FewSteps(space, self.costs, self.gradient, self.value, self.simulator.unit, self.repeats.spread)
        for step in ROUNDS:
            quick.run_round(step)
        outcome = quick.check()
        if outcome.cause in FAULTS:
            added = replace(outcome.parts[0], verdict=verdict, name=f"number {index}")
            self.check = replace(self.check, parts=(added, *self.check.parts))

    def _check_under_other_noise(self, space: Subspace) -> None:
        """Check the gradient along random directions under other draws of the simulator's own noise."""
        if self.w is None or not self.check.trusted or self.is_quick:
            return
        options = replace(self._options(space.size, 0), components=0, scanned=0, repeated=False)
        with self.clock.stage("checks under other noise", self.left_out):
            if not self.clock.can_afford(*self._cost_of(options, 0), share=SHARE):
                raise OutOfTime
            for _ in range(OTHER_NOISE):
                w = self._random.standard_normal((self.simulator.noise, 1))
                self.more.append(space.restore(self._check_once(space, options, w)))


def _with_zeros(outcome: Check) -> Check:
    """Return a check in which a derivative below the rounding of a cost that does not move is ``zero``."""

    def is_zero(part: Part) -> bool:
        return part.verdict in (*TRUSTED, "unsettled") and is_nothing(part.sample)

    if all(part.verdict == "zero" for part in filter(is_zero, outcome.parts)):
        return outcome
    return recaused(outcome, lambda part: replace(part, verdict="zero") if is_zero(part) else part)


def recaused(outcome: Check, replaced: Callable[[Part], Part] = lambda part: part) -> Check:
    """Return a check with replaced parts and the cause that follows from its parts."""
    parts, draws = tuple(map(replaced, outcome.parts)), tuple(map(replaced, outcome.draws))
    return replace(outcome, parts=parts, draws=draws, cause=cause_of(parts, draws))
