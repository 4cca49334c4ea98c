"""Checks a gradient by components, random directions and other thetas, and finds the cause of errors.

The check is independent of problems: cost and gradient are callables of theta.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from . import roughness
from .causes import Ratio, causes_of_ratios
from .direction import EPS, FINE, GUARD, Finding, Function, Sample, judge
from .rules import FAULTS, RULES, TRUSTED, UNEQUAL, VERDICTS
from .sampling import Lines, Modes, repeats, sampled

Tangent = Callable[[np.ndarray, np.ndarray], float]
"""A derivative at a theta along a direction, both ``(d,)``, from the cost's code but not from its gradient; NaN if unknown."""
AGREES = 1e-3
"""Relative difference of the gradient from a tangent up to which they agree: on a chaotic rollout, both have errors."""
MATTERS = 1e3
"""Change of the cost by a hundredth of a tiny input, in unit roundoffs, from which on the input's size is its scale."""
ELSEWHERE = 4
"""Most other thetas at which the ratio of a wrong component is computed."""
LOOSE = 1e-3
"""Largest error of a slope, relative to the largest |gradient * scale|, that a solver which stops early explains."""
EXPLAINED = 10.0
"""Largest such error as a multiple of the sum of the cost's jumps per unit of a direction."""
FAR = (1.0, 3.0)
"""Standard deviations, in units of each input's scale, of thetas where a term such as a contact may be inactive."""
PLAINLY = ("smooth", "nonlinear", "mode_crossing")
"""Verdicts that count as right at the thetas drawn with :data:`FAR`."""
CLEAR = (*PLAINLY, "zero", "nonfinite", "nondeterministic")
"""Verdicts on a direction that is not searched for a staircase."""
SHARE = 0.1
"""Smallest share of the jumps in the cost's change on a staircase, in units of the gradient's relative error that they explain."""


@dataclass(frozen=True)
class Options:
    """The scope of a check."""

    components: int = 16
    """Most components checked one by one; of more, half have the largest |gradient * scale|, half the smallest."""
    directions: int = 2
    """Number of random directions, drawn in units of each input's own scale."""
    draws: int = 8
    """Number of other thetas around the given theta, each checked along random directions."""
    reach: float = 0.05
    """Standard deviation of the other thetas, in units of each input's own scale."""
    eps: np.ndarray = field(default_factory=lambda: EPS)
    """Steps in falling order, relative to each input's own scale."""
    unit: float = float(np.finfo(np.float64).eps)
    """Declared unit roundoff of the arithmetic; the noise of the cost is measured in addition."""
    step: float = 0.0
    """Step of the differences that are the gradient, in units of theta: where slopes change, they err by as much as over it."""
    scale: np.ndarray | None = None
    """The scale of each input ``(d,)``; None uses :func:`scales`."""
    scanned: int = 4
    """Most directions scanned for a staircase, at about 450 costs each."""
    repeated: bool = True
    """Whether every cost at theta is computed twice, which exposes costs that do not repeat."""
    seed: int = 0
    """Seed of the random directions and thetas."""


@dataclass(frozen=True, kw_only=True)
class Part(Finding):
    """One derivative checked: a component of the gradient, or the slope along a random direction."""

    name: str
    """``component 3``, ``direction 0`` or ``other theta 2 direction 0``."""
    component: int | None = None
    sample: Sample
    modes: tuple[Sequence[str], Sequence[str]] = ((), ())
    """Contact modes at each step, on the minus and on the plus side; empty without contact modes."""

    @property
    def program(self) -> float:
        """The program's derivative."""
        return self.sample.derivative

    @property
    def order(self) -> float:
        """Order in h of the Taylor remainder |f(x + h d) - f(x) - h g d|: 2 for a right gradient, 1 for a wrong one.

        The order is the median slope, in log scales, over the five smallest steps on either side whose remainder exceeds
        ten times the noise. It is NaN with fewer than four such steps, as for a linear cost. No choice of a best step is
        needed.
        """
        sample, slopes = self.sample, []
        for side, sign in ((sample.plus, 1.0), (sample.minus, -1.0)):
            with np.errstate(all="ignore"):
                rest = np.abs(side - sample.centre - sign * sample.step * sample.derivative)
                clear = np.flatnonzero(np.isfinite(rest) & (rest > 10.0 * sample.uncertainty * sample.step))[-5:]
            if clear.size >= 4:
                slopes += list(np.diff(np.log(rest[clear])) / np.diff(np.log(sample.step[clear])))
        return float(np.median(slopes)) if slopes else float("nan")

    @property
    def ratio(self) -> float:
        """The program's derivative over the difference; NaN for 0 / 0."""
        with np.errstate(all="ignore"):
            return float(np.float64(self.program) / np.float64(self.difference))

    @property
    def apart(self) -> float:
        """|program - difference|."""
        return abs(self.program - self.difference)

    @property
    def error(self) -> float:
        """|program - difference| over the larger of the two; 0 for two zeros."""
        size = max(abs(self.program), abs(self.difference))
        return 0.0 if size == 0.0 else self.apart / size

    @property
    def distance(self) -> float:
        """|program - difference| over the difference; infinite where that is not a number."""
        with np.errstate(all="ignore"):
            apart = self.apart / np.float64(abs(self.difference))
        return float("inf") if np.isnan(apart) else float(apart)

    @property
    def ratio_with_error(self) -> Ratio:
        """The ratio with the error that follows from that of the difference."""
        size = abs(self.difference)
        return Ratio(self.ratio, abs(self.ratio) * self.uncertainty / size if size > 0.0 else 0.0)


@dataclass(frozen=True)
class Check:
    """The outcome of a check."""

    cause: str
    """The verdict of :func:`cause_of`, one of :data:`.rules.VERDICTS`; ``undecided`` without a part."""
    parts: tuple[Part, ...]
    """Components and random directions at theta."""
    draws: tuple[Part, ...]
    """Random directions at other thetas."""

    @property
    def noise(self) -> float:
        """Measured standard deviation of the cost's noise."""
        return max((part.sample.noise for part in self.parts), default=0.0)

    @property
    def order(self) -> float:
        """Median order of the Taylor remainder along the random directions, NaN where noise hides it."""
        orders = [part.order for part in self.parts if part.component is None]
        known = [order for order in orders if np.isfinite(order)]
        return float(np.median(known)) if known else float("nan")

    @property
    def trusted(self) -> bool:
        """Whether the gradient may be used."""
        return self.cause in TRUSTED

    @property
    def components(self) -> tuple[Part, ...]:
        """The components, without random directions."""
        return tuple(part for part in self.parts if part.component is not None)

    @property
    def worst_parts(self) -> tuple[Part, ...]:
        """The parts with the worst verdict, or all unequal ones where it is one of these: at theta if any, else at other thetas."""
        causes = UNEQUAL if self.cause in UNEQUAL else (self.cause,)
        here = tuple(part for part in self.parts if part.verdict in causes)
        return here or tuple(part for part in self.draws if part.verdict in causes)

    def worst_of(self, parts: Sequence[Part]) -> Part:
        """Return the part with the largest error among those with the cause as their verdict, or among all."""
        return max([part for part in parts if part.verdict == self.cause] or parts, key=lambda part: part.distance)

    def sentence(self) -> str:
        """Return the verdict in one sentence, with the numbers of the worst part."""
        text = f"{self.cause}: {RULES[self.cause].meaning}"
        if self.trusted or not self.worst_parts:
            return text
        part = self.worst_of([p for p in self.worst_parts if p.component is not None] or self.worst_parts)
        return (
            f"{text}; {part.name}: the program's {part.program:.6g}, differences {part.difference:.6g} +- {part.uncertainty:.1g} "
            f"at a step of {part.step:.1g} (ratio {part.ratio:.6g}), slopes {part.left:.6g} and {part.right:.6g}"
        )


def cause_of(parts: Sequence[Part], draws: Sequence[Part] = (), others: Sequence[str] = ()) -> str:
    """Return the worst verdict of parts at theta, of faults at other thetas, and of ``others``.

    Among the derivatives that are other numbers than the differences, it is the verdict of most components, and of most
    directions where all components are right; of two that are as frequent, the worse.
    """
    found = [p.verdict for p in parts] + [p.verdict for p in draws if p.verdict in FAULTS] + [*others]
    worst = min(found, key=VERDICTS.index)
    if worst not in UNEQUAL:
        return worst
    wrong = [part for part in (*parts, *draws) if part.verdict in UNEQUAL]
    wrong = [part for part in wrong if part.component is not None] or wrong
    verdicts = [part.verdict for part in wrong] or [worst]
    return min(verdicts, key=lambda verdict: (-verdicts.count(verdict), VERDICTS.index(verdict)))


NOTHING = Check("undecided", (), ())
"""The outcome of a check that was not made."""


def scales(theta: np.ndarray) -> np.ndarray:
    """Return the scale of each input ``(d,)``: its magnitude, or 1 where it is at most 1e-14 of the largest, or of 1."""
    size = np.abs(theta)
    least = 1e-14 * max(1.0, float(size.max(initial=0.0)))
    return np.where(size > least, size, 1.0)


def check(
    cost: Function,
    gradient: Function | None,
    theta: np.ndarray,
    options: Options | None = None,
    modes: Modes | None = None,
    tangent: Tangent | None = None,
) -> Check:
    """Return the verdict on a gradient at ``theta (d,)``, checked against differences of its cost.

    Each component is checked at the steps of ``options.eps``, relative to its own scale. Random directions check all
    components together, at theta and at other thetas. The gradient is computed at theta before and after the gradients
    at other thetas, which exposes a cached or random gradient. ``modes`` returns the names of contact modes, if any.
    Directions at theta that these steps leave unsettled are checked down to steps of 1e-13, and then against
    ``tangent``, which can only confirm a derivative. Without a gradient, only the cost is checked.

    Raises :class:`TypeError` for complex costs or gradients and :class:`ValueError` for wrong shapes.
    """
    return _Checker(cost, gradient, np.array(theta, dtype=np.float64), options or Options(), modes, tangent).run()


def extremes(weights: np.ndarray, most: int) -> list[int]:
    """Return the indices of at most ``most`` numbers: half of them the largest in size, half the smallest."""
    if weights.size <= most:
        return list(range(weights.size))
    order = np.argsort(np.nan_to_num(np.abs(weights), nan=np.inf), kind="stable")
    return sorted(int(i) for i in np.r_[order[: most // 2], order[order.size - (most - most // 2) :]])


def settle(
    cost: Function, theta: np.ndarray, vector: np.ndarray, length: float, sample: Sample, tangent: Tangent | None
) -> Finding | None:
    """Return the finding on an unsettled direction from smaller steps or from the tangent; None if it stays unsettled."""
    line = Lines(theta, vector[:, None], np.array([sample.derivative]), length, sample.doubt, sample.moved)
    (fine,), *_ = sampled(cost, line, sample.unit, FINE)
    better = judge(fine)
    if better.verdict != "unsettled":
        return better
    slope = float("nan") if tangent is None else tangent(theta, vector) / length
    if abs(slope - sample.derivative) <= AGREES * abs(slope):
        return replace(judge(sample), verdict="nonlinear", difference=slope, uncertainty=AGREES * abs(slope))
    return None


@dataclass(frozen=True)
class _Line:
    """A direction to check: from ``theta (d,)`` along ``vector (d,)``, where the program has ``gradient (d,)``.

    A derivative is per unit of ``length``, the vector's length in units of the derivative: of the input for a component, of
    the inputs' scales for a random direction.
    """

    name: str
    theta: np.ndarray
    gradient: np.ndarray
    vector: np.ndarray
    length: float = 1.0
    component: int | None = None


@dataclass
class _Checker:
    """One check: what is given, the random numbers, and what was measured of a loose solver."""

    _cost: Function
    _gradient: Function | None
    theta: np.ndarray
    options: Options
    _modes: Modes | None
    _tangent: Tangent | None

    def __post_init__(self) -> None:
        if self.theta.ndim != 1 or not self.theta.size:
            raise ValueError(f"theta is a vector of at least one number, not of shape {self.theta.shape}")
        scale, self.unit = self.options.scale, self.options.unit
        self.scale = self._scales() if scale is None else np.asarray(scale, dtype=np.float64)
        self.random = np.random.default_rng([self.options.seed, 0x67726164])
        self._rates: list[float] = []

    def _scales(self) -> np.ndarray:
        """Return :func:`scales`, with its own magnitude for each tiny input that changes the cost at that magnitude."""
        scale = scales(self.theta)
        tiny = np.flatnonzero((self.theta != 0.0) & (scale > np.abs(self.theta)))
        if tiny.size:
            moved = np.repeat(self.theta[:, None], tiny.size + 1, axis=1)
            moved[tiny, np.arange(tiny.size)] *= 1.01
            with np.errstate(all="ignore"):
                values = self.cost(moved)
                least = MATTERS * self.unit * np.abs(values).max(initial=0.0)
                matters = np.abs(values[:-1] - values[-1]) > least
            scale[tiny[matters]] = np.abs(self.theta[tiny[matters]])
        return scale

    def cost(self, thetas: np.ndarray) -> np.ndarray:
        return _real("cost", self._cost(thetas), thetas.shape[1:])

    def gradient(self, theta: np.ndarray) -> np.ndarray:
        if self._gradient is None:
            return np.zeros(theta.size)
        return _real("gradient", self._gradient(theta.copy()), theta.shape)

    def run(self) -> Check:
        theta, options = self.theta, self.options
        first = self.gradient(theta)
        drawn = self.random.standard_normal((theta.size, options.draws)).T
        # theta changes only in its last digits, so every change of the gradient is rounding
        with np.errstate(invalid="ignore"):
            moved = np.abs(self.gradient(theta + 4.0 * self.unit * self.scale) - first)
        self._moved = np.nan_to_num(moved, nan=0.0, posinf=0.0)
        elsewhere = [(other, self.gradient(other)) for other in theta + options.reach * self.scale * drawn]
        again = self.gradient(theta)
        chosen = extremes(first * self.scale, options.components)
        lines = [self._along(i, theta, first) for i in chosen]
        parts = self._check_lines([*lines, *self._directions("", theta, first)], is_thorough=True)
        draws = self._check_lines(
            [line for k, each in enumerate(elsewhere) for line in self._directions(f"other theta {k} ", *each)]
        )
        parts, draws = self._with_causes(parts, draws, elsewhere)
        others = []
        if not np.isfinite(first).all() and np.isfinite(self.cost(theta[:, None])).all():
            others.append("nan_gradient")
        elif not repeats(first, again, self.unit).all():
            others.append("nondeterministic")
        # at other thetas only faults count: a kink at another theta is not a kink at theta
        return Check(cause_of(parts, draws, others), tuple(parts), tuple(draws))

    def _along(self, component: int, theta: np.ndarray, gradient: np.ndarray) -> _Line:
        """Return the line of a component, whose vector has the length of the component's scale."""
        scale = self.scale[component]
        return _Line(
            f"component {component}", theta, gradient, scale * np.eye(1, theta.size, component)[0], scale, component
        )

    def _directions(self, name: str, theta: np.ndarray, gradient: np.ndarray) -> list[_Line]:
        """Return lines along random vectors of length 1 in units of the inputs' scales."""
        random = self.random.standard_normal((theta.size, self.options.directions))
        random *= self.scale[:, None] / np.linalg.norm(random, axis=0)
        return [_Line(f"{name}direction {i}", theta, gradient, vector) for i, vector in enumerate(random.T)]

    def _check_lines(self, lines: Sequence[_Line], is_thorough: bool = False) -> list[Part]:
        """Return a checked part for each line, from one batch of costs.

        A thorough check computes costs twice, and searches for staircases and for smaller steps that settle a direction.
        """
        if not lines:
            return []
        thetas, gradients, vectors = (
            np.stack([getattr(line, name) for line in lines], axis=1) for name in ("theta", "gradient", "vector")
        )
        lengths = np.array([line.length for line in lines])
        with np.errstate(invalid="ignore"):
            program = np.where(vectors != 0.0, vectors * gradients, 0.0).sum(axis=0) / lengths
        whole = np.abs(np.nan_to_num(gradients, posinf=0.0, neginf=0.0)) * self.scale[:, None]
        largest = whole.max(axis=0)
        # a component this much smaller than the others may be only their error, unless it is exactly 0
        doubt = np.maximum(np.sqrt(self.unit), self.options.step / lengths)
        doubts = np.where(program != 0.0, doubt * largest / lengths, 0.0)
        moved = np.abs(vectors).T @ self._moved / lengths
        samples, minus, plus = sampled(
            self.cost,
            Lines(thetas, vectors, program, lengths, doubts, moved),
            self.unit,
            self.options.eps,
            self._modes,
            is_thorough and self.options.repeated,
        )
        if self._gradient is None:
            samples = [replace(sample, derivative=judge(sample).difference) for sample in samples]
        parts = [
            Part(
                name=line.name,
                component=line.component,
                sample=sample,
                modes=(tuple(a), tuple(b)),
                **vars(judge(sample)),
            )
            for line, sample, a, b in zip(lines, samples, minus, plus, strict=True)
        ]
        if is_thorough:
            parts = self._with_staircases(lines, parts)
            parts = [self._settled(line, part) for line, part in zip(lines, parts, strict=True)]
        return self._with_loose_solvers(lines, parts, largest)

    def _settled(self, line: _Line, part: Part) -> Part:
        """Return an unsettled part with the finding of smaller steps or of the tangent; others as they are."""
        if part.verdict != "unsettled" or self._gradient is None:
            return part
        finding = settle(self.cost, line.theta, line.vector, line.length, part.sample, self._tangent)
        return part if finding is None else replace(part, **vars(finding))

    def _with_loose_solvers(self, lines: Sequence[_Line], parts: list[Part], largest: np.ndarray) -> list[Part]:
        """Return the parts; wrong ones are ``rounding`` where small jumps of the cost, of a solver that stops early, explain them.

        ``largest`` is the largest |gradient * scale| at each line's theta. No solver excuses an error that is plainly wrong.
        """
        errors = [line.length * part.apart for line, part in zip(lines, parts, strict=True)]
        wrong = [m for m, part in enumerate(parts) if part.verdict == "wrong_adjoint"]
        if all(errors[m] <= LOOSE * largest[m] for m in wrong):
            for m in wrong:
                if self._has_loose_solver(lines[m], errors[m]):
                    parts[m] = replace(parts[m], verdict="rounding")
        return parts

    def _has_loose_solver(self, line: _Line, apart: float) -> bool:
        """Return whether small jumps of the cost explain an error ``apart`` of a slope in units of the inputs' scales.

        The cost is scanned along its gradient, for at most :attr:`Options.scanned` thetas.
        """
        steepest = self.scale * line.gradient
        vector = self.scale * steepest / np.linalg.norm(steepest)
        for reach in roughness.REACHES:
            if apart <= EXPLAINED * max(self._rates, default=0.0):
                return True
            if len(self._rates) >= len(roughness.REACHES) * self.options.scanned:
                return False
            along = np.linspace(-reach, reach, roughness.STOPPED)
            with np.errstate(all="ignore"):
                values = self.cost(line.theta[:, None] + vector[:, None] * along)
                least = 8.0 * self.unit * float(np.abs(values).max())
                self._rates.append(roughness.stopping_rate(values, 2.0 * reach, least))
        return apart <= EXPLAINED * max(self._rates)

    def _with_staircases(self, lines: Sequence[_Line], parts: list[Part]) -> list[Part]:
        """Return the parts, judged again for each direction along which the cost is a staircase.

        Directions that are clearly right are not scanned. A derivative of exactly 0 is not clearly right where
        differences are not 0, since it may be the slope of a tread.
        """
        to_scan = [
            m
            for m, part in enumerate(parts)
            if part.verdict not in CLEAR
            or (part.verdict == "nonlinear" and part.program == 0.0 and part.sample.differences.any())
        ]
        along = roughness.staircase_offsets(self.unit)
        for m in to_scan[: self.options.scanned]:
            at = lines[m].theta[:, None] + lines[m].vector[:, None] * along.reshape(1, -1)
            for row in self.cost(at).reshape(along.shape):
                if roughness.is_staircase(row, 8.0 * self.unit * float(np.abs(row).max())):
                    parts[m] = self._judge_staircase(parts[m], row)
                    break
        return parts

    def _judge_staircase(self, part: Part, row: np.ndarray) -> Part:
        """Return the part on a staircase: ``precision`` where the gradient is right on scales above its treads.

        A cast to a shorter float keeps the gradient, a cast to an integer removes it.
        """
        sample, steps = part.sample, np.diff(row)
        tread, jumped = float(np.ptp(steps)), np.abs(steps - np.median(steps)).sum() / np.abs(steps).sum()
        if GUARD * float(self.unit) * abs(sample.centre) >= tread or jumped < SHARE * min(part.error, 1.0):
            return part
        coarse = judge(replace(sample, noise=max(sample.noise, tread)))
        verdict = "precision" if coarse.verdict in TRUSTED else "staircase"
        return replace(part, **(vars(coarse) | {"verdict": verdict}))

    def _with_causes(
        self, parts: list[Part], draws: list[Part], elsewhere: Sequence[tuple[np.ndarray, np.ndarray]]
    ) -> tuple[list[Part], list[Part]]:
        """Return ``parts`` and ``draws`` with the cause of each wrong derivative as its verdict.

        Causes come from the ratios of derivatives to differences at theta and ``elsewhere``, at other thetas with their
        gradients.
        """
        wrong = [part for part in (*parts, *draws) if part.verdict in ("wrong_adjoint", "disconnected")]
        if not wrong:
            return parts, draws
        here = [part for part in parts if part.verdict in FAULTS]
        gradients = [gradient for _, gradient in elsewhere]
        if gradients and gradients[0].any() and not np.ptp(gradients, axis=0).any() and not here:
            return parts, [_named(part, "stale_gradient") for part in draws]
        ratios = {part.component: [part.ratio_with_error] for part in wrong if part.component is not None}
        again = self._check_lines([self._along(i, *each) for each in elsewhere[:ELSEWHERE] for i in ratios])
        for part in again:
            if part.component is not None and part.verdict in ("wrong_adjoint", *TRUSTED):
                ratios[part.component].append(part.ratio_with_error)
        along = [part.ratio_with_error for part in wrong if part.component is None and part.verdict == "wrong_adjoint"]
        is_some_right = any(p.verdict in TRUSTED and p.verdict != "zero" for p in parts if p.component is not None)
        causes = causes_of_ratios(ratios, along, is_some_right)
        if "wrong_adjoint" in causes.values() and self._is_right_far_away():
            causes = causes_of_ratios(ratios, along, is_some_right, right_elsewhere=True)
        renamed = [_named(part, causes.get(part.component, causes[None])) for part in parts]
        return renamed, [_named(part, causes[None]) for part in draws]

    def _is_right_far_away(self) -> bool:
        """Return whether the gradient is right at some theta farther away, so that a missing term acts only near theta.

        A slope of exactly 0 does not count.
        """
        count = self.options.draws
        away = np.repeat(FAR, count) * self.scale[:, None]
        thetas = (self.theta[:, None] + away * self.random.standard_normal((self.theta.size, len(FAR) * count))).T
        lines = [
            _Line("", each, self.gradient(each), self.scale * self.random.standard_normal(each.size)) for each in thetas
        ]
        return any(part.verdict in PLAINLY for part in self._check_lines(lines))


def _real(name: str, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return values as float64; raises :class:`TypeError` for complex ones and :class:`ValueError` for another shape."""
    if np.iscomplexobj(values):
        raise TypeError(f"the {name} is complex; a check needs a real one")
    if np.shape(values) != shape:
        raise ValueError(f"the {name} has shape {np.shape(values)}, not {shape}")
    return np.asarray(values, dtype=np.float64)


def _named(part: Part, cause: str) -> Part:
    """Return a part with the cause of its wrong derivative as its verdict."""
    return replace(part, verdict=cause) if part.verdict == "wrong_adjoint" else part
