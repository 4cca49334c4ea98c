"""Reference gradients from a closed form, quadrature or long sampling, each with an error intended as a bound."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from bench.measure import noise
from bench.measure.batches import N_COLUMNS, in_columns
from bench.measure.jumps import coordinates, largest_jump
from bench.measure.quadrature import TOLERANCE, integrate
from bench.measure.statistics import THREE, Sampling, Truth, bias_interval, heavy_tails
from bench.model import Problem, Program
from bench.model.blocks import OfColumns

BATCHES = 64
"""Number of independent batch means that represent a sampled reference."""
LEAST_SAMPLES = 16384
"""Minimum samples of a sampled reference, unless the limit is lower: a small spread of few samples proves nothing."""
TAIL_EVENTS = 10.0
"""Expected samples in the tails. Their contribution is estimated separately, as a spread may not show so few samples."""
DEEPER = 0.2
"""Spacing of the points along a direction beyond the deepest sample of the tails, in standard deviations."""
DIRECTIONS = 16
"""Most coordinate directions in noise space searched for tails and jumps, besides the direction of the mean effect."""
FAR = 4.5
"""Distance searched for jumps on either side along a direction, in standard deviations."""
AGREE = 1e-9
"""Difference of gradients, relative to their size, up to which they agree."""
COMMON_ERROR = 1e-10
"""Relative error common to the terms of all samples, from rounding and central differences."""
EXTREME = 1e100
"""Size of costs above which, or below the inverse of which, their squares would leave the range of float64."""
REVISIONS = {"closed_form": 1, "quadrature": 1, "sampling": 1, "smoothed": 1}
"""Revision of each method. It is raised when a stored reference of that method moves."""
WARNED, REFUSED = 0.999, 1.0 - 1e-6
"""Confidence levels at which a difference of first from zeroth order adds a note, and makes zeroth order replace first."""


@dataclass(frozen=True)
class Reference:
    """A reference for grad J_sigma, with its error.

    ``batches (K, d)`` are independent estimates whose mean is the gradient, or one row where the gradient has no
    sampling error. ``error`` is the norm of the error that their spread does not show: the error of a deterministic
    method, or the effect of the tails. ``plain (d,)`` is the program's gradient at w = 0, and ``physical (d,)`` the
    gradient of the physics that the program approximates. Each is empty when unknown. ``note`` states what could not be
    certified. ``spacing`` is the average spacing of the points of quadrature, in standard deviations of the noise. A
    feature of the cost that is narrower may be missed. In one dimension most are found, as panels are halved where
    costs change. It is NaN for other methods. ``samples`` is the number of samples, 0 for methods without samples.
    """

    batches: np.ndarray
    method: str
    error: float = 0.0
    plain: np.ndarray = field(default_factory=lambda: np.empty(0))
    physical: np.ndarray = field(default_factory=lambda: np.empty(0))
    note: str = ""
    spacing: float = math.nan
    samples: int = 0

    @property
    def gradient(self) -> np.ndarray:
        """grad J_sigma, ``(d,)``."""
        return self.batches.mean(axis=0)

    @property
    def is_finite(self) -> bool:
        """Whether the gradient is known; if not, the note and the method state why."""
        return bool(np.isfinite(self.batches).all())

    def known(self) -> Truth:
        """Return the reference as a :class:`Truth`: mean, sampling error, and the error that sampling does not show."""
        if len(self.batches) > 1:
            return Truth.from_batches(self.batches, self.error)
        return Truth.exact(self.gradient, self.error)

    @property
    def model_error(self) -> float:
        """|program's gradient - physics' gradient| at w = 0, or NaN when the physics has no closed form."""
        return float(np.linalg.norm(self.plain - self.physical)) if self.physical.size else math.nan


def certify(
    problem: Problem,
    provides: frozenset[str],
    samples: int,
    tolerance: float,
    physical: np.ndarray | None = None,
    points: int = 1 << 20,
) -> Reference:
    """Return the reference gradient of a problem, by the best applicable method.

    A closed form belongs to the scene's own program, so it is not used for a backend that ``provides`` its own physics.
    Quadrature handles noise on theta of one or two dimensions, or of one only if the cost may jump at places that the
    scene does not list. If its relative error exceeds 0.1%, sampling replaces quadrature where the error of sampling is
    smaller. Sampling stops at an error of ``tolerance`` times the gradient's norm, or after ``samples`` samples,
    quadrature at ``points`` points, or 64 times ``samples``.
    ``physical (d,)`` is the gradient of the physics that the program approximates, if known. Where costs are not
    finite, or J does not exist, the gradient is NaN and the note states why.
    """
    program = problem.program
    theta = program.theta0
    if program.surrogate:
        # its gradient is not the derivative of the program, so only costs can certify a reference
        provides = provides - {"grad"}
    closed = None if "physics" in provides else program.closed_form_gradient()
    if closed is not None:
        reference = Reference(np.asarray(closed, dtype=np.float64).reshape(1, -1), "closed_form")
    else:
        unit = _unit(problem, theta)
        given = problem if unit == 1.0 else cast(Problem, _Scaled(problem, unit))
        scaled = _compute(given, theta, provides, samples, tolerance, min(points, 64 * samples))
        reference = replace(scaled, batches=scaled.batches * unit, error=scaled.error * unit)
        # spacing of a reference's points, in standard deviations, above which a note states it: that of points in a
        # plane
        if reference.spacing > 1e-3:
            note = f"the reference's points are {reference.spacing:.2g} standard deviations apart and may miss a narrower feature"
            reference = with_note(reference, note)
    if physical is None or "grad" not in provides:
        return reference
    return replace(reference, plain=problem.grad(), physical=np.asarray(physical, dtype=np.float64))


def transferred(reference: Reference, problem: Problem, other: Problem, samples: int, unit: float) -> Reference | None:
    """Return a reference that ``problem`` computed for ``other``, the program on another backend; None if it is not that one's.

    Both compute the costs of the same draws, at most ``samples``, with the unit roundoff ``unit``. Where rounding decides an event, costs differ by more
    than rounding, and grad J by the mean of difference times score. The upper end of its 95% interval is added to the
    stated error. A reference whose stated error is smaller than that is not transferred.
    """
    program, theta, columns = problem.program, problem.program.theta0, min(N_COLUMNS, samples)
    effects, share = [], 0.0
    blocks = max(1, min(samples, LEAST_SAMPLES) // columns)
    for block in range(blocks):
        w = draw_columns(problem, "backends", columns, block)
        with np.errstate(all="ignore"):
            mine, others = problem.value(theta, w), other.value(theta, w)
            spread = np.ptp(mine[np.isfinite(mine)]) if np.isfinite(mine).any() else 0.0
            # rounding explains a difference of 1e-6 of the range of costs, or the root of the coarser unit roundoff if that
            # is more, and 100 roundoffs of the cost itself
            allowed = max(1e-6, math.sqrt(unit)) * spread + 100.0 * unit * np.abs(mine)
            agrees = (mine == others) | (np.abs(others - mine) <= allowed) | (np.isnan(mine) & np.isnan(others))
            share += float(1.0 - agrees.mean()) / blocks
            apart = np.where(agrees, 0.0, others - mine)
            if agrees.all():
                effects.append(np.zeros((columns, problem.dim)))
            elif program.score_refusal or not problem.sigma > 0.0:
                return None
            else:
                effects.append((apart * problem.score(theta, w)).T)
    effect = np.concatenate(effects)
    if not share or not np.isfinite(effect).all():
        return None if share else reference
    most = bias_interval(effect.mean(axis=0), Sampling.of(effect))[2]
    if not most <= reference.known().standard_error:
        return None
    note = f"costs differ from those of the backend that computed the reference in {share:.2g} of draws, as its error allows"
    return with_note(replace(reference, error=math.hypot(reference.error, most)), note)


def revisions(program: Program, provides: frozenset[str]) -> dict[str, int]:
    """Return the revisions of the methods that :func:`certify` may use for a program."""
    if "physics" not in provides and program.closed_form_gradient() is not None:
        names = ["closed_form"]
    else:
        names = ["sampling"] + ["quadrature"] * _can_integrate(program)
    return {name: REVISIONS[name] for name in names}


def _can_integrate(program: Program) -> bool:
    """Return whether quadrature can integrate over the noise."""
    return program.noise_on_theta and program.n_noise <= (1 if _unlisted_jumps(program) else 2)


def _compute(
    problem: Problem, theta: np.ndarray, provides: frozenset[str], samples: int, tolerance: float, points: int
) -> Reference:
    program = problem.program
    quadrature = None
    if _can_integrate(program):
        integral = integrate(problem, theta, points)
        if integral is not None:
            method = f"quadrature[points={integral.points},spacing={integral.spacing:.2g}]"
            quadrature = Reference(
                integral.gradient[None, :], method, integral.error, note=integral.note, spacing=integral.spacing
            )
            if math.isnan(integral.error):
                return replace(quadrature, method="quadrature[failed: the mean cost may not exist]")
            if integral.error <= TOLERANCE * np.linalg.norm(integral.gradient):
                return quadrature
    sampled = _Sampler(problem, theta, provides, samples, tolerance).reference()
    if quadrature is None:
        return sampled
    # a gradient near zero has no relative accuracy: there the method with the smaller error is used
    if not sampled.is_finite:
        return quadrature
    apart, error = float(np.linalg.norm(sampled.gradient - quadrature.gradient)), sampled.known().standard_error
    # stated errors of quadrature and sampling together beyond which they disagree
    if apart > 3.0 * math.hypot(error, quadrature.error):
        note = f"quadrature and sampling disagree by {apart:.2g}, which is the stated error"
        return with_note(replace(quadrature, error=max(apart, quadrature.error)), note)
    # doubts about the samples are doubts about their error
    if not sampled.note and 0.0 < error < quadrature.error:
        # tails may be too heavy for the spread of the samples to show, as at a pole in the plane
        return with_note(replace(sampled, error=max(sampled.error, apart)), quadrature.note)
    return with_note(quadrature, sampled.note)


def _unit(problem: Problem, theta: np.ndarray) -> float:
    """Return the power of 2 that costs are divided by, so that their squares are in range; 1 for usual costs."""
    # one column at a time, as for the cost at w = 0, so that a compiling backend compiles no other shape
    # samples that show the size of the costs
    samples = draw_columns(problem, "unit", 4, 0)
    values = np.abs(np.concatenate([problem.value(theta, w[:, None]) for w in samples.T]))
    size = float(values[np.isfinite(values)].max(initial=0.0))
    return 1.0 if size == 0.0 or 1.0 / EXTREME <= size <= EXTREME else 2.0 ** math.floor(math.log2(size))


class _Scaled:
    """A problem whose costs and gradients are divided by a unit."""

    def __init__(self, problem: Problem, unit: float) -> None:
        self._problem, self._unit = problem, unit

    def __getattr__(self, name: str) -> Any:
        return getattr(self._problem, name)

    def value(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return self._problem.value(theta, w) / self._unit

    def grad(self, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        return self._problem.grad(theta, w) / self._unit


def assumes_continuity(program: Program) -> bool:
    """Return whether the scene's or the contact law's class does not declare that it is continuous.

    A class declares ``continuous`` itself, or inherits the declaration together with all methods: a method that a class
    further down replaces may jump where the inherited one did not.
    """
    parts = (program.scene, program.contact)
    return any(part is not None and not _declares_continuity(type(part)) for part in parts)


def _declares_continuity(plugin: type) -> bool:
    for owner in plugin.__mro__:
        # modules of the contracts, whose defaults are not declarations
        is_contract = owner.__module__.startswith("bench.model.")
        if "continuous" in vars(owner):
            return not is_contract
        if not is_contract and any(callable(value) for name, value in vars(owner).items() if name[0] != "_"):
            return False
    return False


def _unlisted_jumps(program: Program) -> bool:
    """Return whether the cost may jump at places that the breakpoints do not list, such as the jumps of a contact law."""
    if program.contact is not None and not program.contact.continuous:
        return True
    return not program.continuous and not any(program.breakpoints())


# ------------------------------------------------------------------------------------------------ sampling


Terms = OfColumns
"""Maps noise ``(n_w, B)`` to per-sample terms ``(d, B)`` whose expectation is the gradient."""


class _Sampler:
    """Sampled references of a problem: the orders that are valid, each with its terms of a pilot."""

    def __init__(
        self, problem: Problem, theta: np.ndarray, provides: frozenset[str], samples: int, tolerance: float
    ) -> None:
        program = problem.program
        self.problem, self.theta, self.samples, self.tolerance = problem, theta, samples, tolerance
        self.columns = min(N_COLUMNS, BATCHES * max(1, samples // (4 * BATCHES)))
        self.centre = problem.value(theta, np.zeros((program.n_noise, 1)))
        self.orders: dict[str, Terms] = {}
        if not program.score_refusal:
            self.orders["zeroth_order"] = lambda w: self._antithetic((w, -w), self.centre)
        if program.continuous and "grad" in provides:
            self.orders["first_order"] = lambda w: problem.grad(theta, w)
        self.pilot = draw_columns(problem, "pilot", self.columns, 0)
        pilots = {name: terms(self.pilot) for name, terms in self.orders.items()}
        self.pilots = {name: terms for name, terms in pilots.items() if np.isfinite(terms).all()}

    def reference(self) -> Reference:
        """Return a sampled reference from the valid estimator of lowest variance, checked against zeroth order.

        First order is valid where the cost is continuous. Zeroth order replaces it, with a note, where the cost jumps on a
        line through the samples or the two estimators disagree.
        """
        problem, pilots = self.problem, self.pilots
        if not pilots:
            return _failed(problem, "rollouts are not finite" if self.orders else problem.program.score_refusal)
        effect = self.pilot @ (problem.value(self.theta, self.pilot) - self.centre)
        self.directions = _directions(effect if np.isfinite(effect).all() else np.zeros(len(self.pilot)))
        spread = {name: float(terms.var(axis=1, ddof=1).sum()) for name, terms in pilots.items()}
        chosen, doubt = min(spread, key=lambda name: spread[name]), ""
        if chosen == "first_order":
            doubt = self._doubt_of_first_order()
        if doubt and "zeroth_order" in pilots:
            chosen = "zeroth_order"
        reference = self._sampled(chosen)
        if not reference.is_finite and chosen == "first_order" and "zeroth_order" in pilots:
            # the cost may be finite where its gradient is not
            chosen, doubt = "zeroth_order", "first order is not finite, so zeroth order is used"
            reference = self._sampled(chosen)
        if not reference.is_finite:
            return reference
        if chosen == "zeroth_order" or "zeroth_order" not in pilots:
            return with_note(reference, doubt)
        # a pilot of a heavy-tailed distribution underestimates its variance
        error = reference.known().standard_error
        if 2.0 * spread["zeroth_order"] < reference.samples * error**2:
            other = self._sampled("zeroth_order")
            if other.is_finite and other.known().standard_error < error:
                return other
        return self._cross_checked(reference)

    def _doubt_of_first_order(self) -> str:
        """Return why first order is rejected: zeroth order disagrees in the pilot, or the cost jumps. Empty if neither."""
        if "zeroth_order" in self.pilots:
            # both use the same noise, so their differences are independent samples too
            paired = (self.pilots["first_order"] - self.pilots["zeroth_order"]).T
            low = bias_interval(paired.mean(axis=0), Sampling.of(paired), level=REFUSED)[1]
            if low > AGREE * np.abs(paired).max():
                return "first and zeroth order disagree in the pilot, so zeroth order is used"
        count = min(self.directions.shape[1], self.pilot.shape[1] // 3)
        (through, first, last), along = np.split(self.pilot[:, : 3 * count], 3, axis=1), self.directions[:, :count]
        through = through - along * (along * through).sum(axis=0)
        starts = np.concatenate([first, through - FAR * along], axis=1)
        ends = np.concatenate([last, through + FAR * along], axis=1)
        jump = largest_jump(
            lambda w: in_columns(lambda part: self.problem.value(self.theta, part), w, self.columns), starts, ends
        ).height
        if jump:
            return (
                f"the cost jumps by {jump:.2g}, which its scene and contact law do not declare, so zeroth order is used"
            )
        return ""

    def _sampled(self, order: str) -> Reference:
        """Return a sampled reference whose error, tails included, is within the tolerance, or that spends all samples."""
        problem, terms = self.problem, self.orders[order]
        for batches, count, error, is_last in doubling_batches(problem, terms, "reference", self.columns, self.samples):
            if not math.isfinite(error):
                return _failed(problem, "rollouts are not finite")
            mean = batches.mean(axis=0)
            allowed = self.tolerance * np.linalg.norm(mean)
            if is_last or (error <= allowed and count >= LEAST_SAMPLES):
                unseen, note = self._tail_error(terms, mean, count)
                if is_last or math.hypot(error, unseen) <= allowed:
                    break
        if math.isinf(unseen):
            return _failed(problem, "noise rarer than any sample dominates the mean, which may not exist")
        if not note and heavy_tails(batches - batches.mean(axis=0)):
            note = "the reference's batches have heavy tails, so its standard error is uncertain"
        elif np.ptp(batches, axis=0).max() <= AGREE * np.abs(batches).max():
            rare = THREE / count
            unseen = math.hypot(unseen, rare * float(np.linalg.norm(batches[0])))
            note = (
                note
                or f"all samples of the reference have the same gradient: events rarer than {rare:.1g} are not seen"
            )
        # the spread does not show an error that all samples share, such as that of a backend's differences
        unseen = math.hypot(unseen, COMMON_ERROR * math.sqrt(float(np.square(self.pilots[order]).sum(axis=0).mean())))
        return Reference(batches, f"sampling[{order},n={count}]", unseen, note=note, samples=count)

    def _cross_checked(self, reference: Reference) -> Reference:
        """Return a first-order reference after comparing it with zeroth order on a quarter of its samples.

        Where the continuity of the cost is only assumed, the comparison uses all samples that the reference left, and the
        stated error includes the comparison's resolution. The method's name records the resolution. After a clear
        disagreement zeroth order replaces it.
        """
        problem, columns = self.problem, self.columns
        assumed = assumes_continuity(problem.program)
        n_check = max(reference.samples // 4, self.samples - reference.samples if assumed else 0)
        # a linear part of the cost, whose zeroth-order estimate is known, only adds noise to the comparison
        linear = reference.gradient if problem.noise_on_theta else np.zeros(problem.dim)

        def zeroth(w: np.ndarray) -> np.ndarray:
            # the same own noise on both sides and in the baseline, so that only the noise on theta moves the terms
            own = problem.centred(w)
            baseline = problem.value(self.theta, own) if problem.program.exogenous else self.centre
            return self._antithetic((w, 2.0 * own - w), baseline, linear)

        blocks = range(max(1, n_check // columns))
        terms = [in_columns(zeroth, draw_columns(problem, "check", columns, block), columns) for block in blocks]
        means = [part.reshape(problem.dim, -1, max(1, columns // BATCHES)).mean(axis=2) for part in terms]
        check = np.concatenate(means, axis=1).T
        check = check.reshape(-1, len(check) // min(BATCHES, len(check)), problem.dim).mean(axis=1)
        if not np.isfinite(check).all():
            return with_note(reference, "zeroth order is not finite, so first order is not checked")
        apart = reference.gradient - check.mean(axis=0)
        errors = Sampling.of(reference.batches), Sampling.of(check)
        trace = sum(error.trace for error in errors)
        rows = np.concatenate([error.rows for error in errors])
        spread = math.sqrt(2.0 * float(np.square(rows @ rows.T).sum()))
        z = float((apart @ apart - trace) / spread) if spread else 0.0 if not apart.any() else math.inf
        size = AGREE * (np.linalg.norm(reference.gradient) + np.linalg.norm(check.mean(axis=0)))
        at = {level: bias_interval(apart, *errors, level=level)[1] > size for level in (WARNED, REFUSED)}
        disagreement = f"first and zeroth order disagree by {np.linalg.norm(apart):.2g} (check_z={z:.1f})"
        if at[REFUSED]:
            return with_note(self._sampled("zeroth_order"), f"{disagreement}, so zeroth order is used")
        resolved = 2.0 * math.sqrt(trace)
        facts = f"check_z={z:.1f},check_resolves={resolved:.2g}{',assumed_continuous' * assumed}"
        method = f"{reference.method.removesuffix(']')},{facts}]"
        error = math.hypot(reference.error, resolved) if assumed else reference.error
        return with_note(replace(reference, method=method, error=error), disagreement if at[WARNED] else "")

    def _tail_error(self, terms: Terms, mean: np.ndarray, count: int) -> tuple[float, str]:
        """Return the norm of the far tails' contribution to the mean, the largest over the directions, and a note.

        The tails contain few of the ``count`` samples or none, so the spread of the samples does not show the contribution.
        Along each direction, the tails are where :data:`TAIL_EVENTS` samples are expected, and are sampled separately. What
        lies beyond these samples, as of an exponential cost, is integrated along the direction. Where terms diverge faster
        than the normal density falls, the note states the distance, and the contribution ends there. The contribution is
        infinite where it exceeds the range whose squares are finite.
        """
        from scipy.special import ndtri

        problem, n_lines = self.problem, self.directions.shape[1]
        share, each = min(1.0, TAIL_EVENTS / count), max(1, self.columns // n_lines)
        along, side = np.repeat(self.directions, each, axis=1), np.where(np.arange(each) % 2, 1.0, -1.0)
        w = draw_columns(problem, "tails", along.shape[1], 0)

        def at(depth: np.ndarray) -> np.ndarray:
            """Return the terms, ``(d, L, each)``, where the component of the noise along each direction is replaced by depths."""
            nonlocal w
            w = w + along * (np.tile(depth, n_lines) - (along * w).sum(axis=0))
            with np.errstate(over="ignore", invalid="ignore"):
                return in_columns(terms, w, self.columns).reshape(problem.dim, n_lines, each)

        middle = (np.arange(each) + 0.5) / each
        depth = -ndtri(0.5 * share * middle)
        tails = at(side * depth)
        if not np.isfinite(tails).all():
            return 0.0, "rollouts in the far tails of the noise are not finite, so the reference may not exist"
        tails = np.abs(tails.mean(axis=2) - mean[:, None])
        if tails.max() > EXTREME:
            return math.inf, ""
        error, note = share * float(np.linalg.norm(tails, axis=0).max()), ""
        # the same noise across the direction, at depths beyond the deepest sample of the tails
        depth = float(depth.max()) + DEEPER * (np.arange(each) // 2 + 0.5)
        weight = np.exp(-(depth**2) / 2) * DEEPER / math.sqrt(2.0 * math.pi)
        with np.errstate(over="ignore", invalid="ignore"):
            deep = np.where(weight > 0.0, at(side * depth) * weight, 0.0)
            sizes = np.abs(deep).max(axis=0)
        for sign in (0, 1):
            for ray in sizes[:, sign::2]:
                finite, end = _convergent_part(ray)
                if finite[end:].sum() > max(error, finite[:end].sum()):
                    limit = depth[sign::2][end - 1]
                    note = f"rollouts beyond {limit:.2g} standard deviations diverge, so the mean may not exist"
                ray[end:] = 0.0
        deep = np.where(sizes > 0.0, deep, 0.0).sum(axis=2)
        if np.abs(deep).max() > EXTREME:
            return math.inf, note
        return error + float(np.linalg.norm(deep, axis=0).max()), note

    def _antithetic(
        self, sides: tuple[np.ndarray, np.ndarray], baseline: np.ndarray, linear: np.ndarray | None = None
    ) -> np.ndarray:
        """Return zeroth-order terms ``(d, B)`` averaged over noise and its mirror image, ``sides``, with a baseline of the costs.

        For noise on theta, ``linear (d,)`` is the gradient of a linear part of the cost. Its terms are replaced by their
        mean, ``linear``, which changes no expectation.
        """
        problem, theta = self.problem, self.theta
        terms = ((problem.value(theta, side) - baseline) * problem.score(theta, side) for side in sides)
        mean = sum(terms) / 2
        if linear is None or not linear.any():
            return mean
        step = problem.directions(sides[0])
        return mean - (linear @ step) * step + linear[:, None]


def _convergent_part(ray: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the finite first sizes ``(k,)`` of terms on a ray, and how many come before they begin to grow; all if all are finite."""
    is_finite = np.isfinite(ray)
    if is_finite.all():
        return ray, ray.size
    finite = ray[: np.argmin(is_finite)]
    return finite, finite.size - int(np.argmin(finite[::-1])) if finite.size else 0


def _directions(effect: np.ndarray) -> np.ndarray:
    """Return unit vectors in noise space, ``(n_w, L)``: evenly spaced coordinates, and the mean effect's direction."""
    directions = coordinates(effect.size, DIRECTIONS)
    length = float(np.linalg.norm(effect))
    return np.column_stack([directions, effect / length]) if length and math.isfinite(length) else directions


def with_note(reference: Reference, note: str) -> Reference:
    """Return a reference with a note before its own; the same if the note is empty."""
    return replace(reference, note="; ".join(part for part in (note, reference.note) if part))


def doubling_batches(
    problem: Problem, terms: Terms, stream: str, columns: int, samples: int
) -> Iterator[tuple[np.ndarray, int, float, bool]]:
    """Yield batch means ``(BATCHES, d)``, the number of their samples, the mean's standard error, and whether they are the last.

    ``terms`` are evaluated ``columns`` at a time, on noise of the named stream. Each pass doubles the samples, at most to
    ``samples``. Means that are not finite are the last, with an infinite error.
    """
    size, count, batches = columns // BATCHES, 0, np.zeros((BATCHES, problem.dim))
    while True:
        w = draw_columns(problem, stream, BATCHES * size, count)
        means = in_columns(terms, w, columns).reshape(problem.dim, BATCHES, size).mean(axis=2).T
        batches = (batches * count + means * size) / (count + size)
        count += size
        is_finite = np.isfinite(batches).all()
        error = math.sqrt(batches.var(axis=0, ddof=1).sum() / BATCHES) if is_finite else math.inf
        is_last = not is_finite or 2 * count * BATCHES > samples
        yield batches, count * BATCHES, error, is_last
        if is_last:
            return
        size = count


def draw_columns(problem: Problem, stream: str, count: int, block: int) -> np.ndarray:
    """Return noise ``(n_w, count)`` from the named stream of a reference, which is independent of the noise of cells."""
    program = problem.program
    drawn = noise.shared(block, program.scene.name, 1, count, program.n_noise, stream=stream)
    return np.moveaxis(drawn, -1, 0).reshape(program.n_noise, count)


def _failed(problem: Problem, reason: str) -> Reference:
    return Reference(
        np.full((1, problem.dim), math.nan), f"sampling[failed: {reason}]", math.nan, note=f"no reference: {reason}"
    )
