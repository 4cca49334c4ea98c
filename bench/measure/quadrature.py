"""Computes smoothed gradients by quadrature, with an error from the disagreement of several rules."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from bench.measure.batches import N_COLUMNS, in_columns
from bench.model import Problem
from bench.model.blocks import OfColumns

NODES = 8
"""Number of Gauss-Legendre nodes per panel."""
LEAST_LIMIT = 9.0
"""Least limit of integration on either side, in standard deviations: beyond it, the normal density is below 1e-17."""
NEAR, FARTHEST = 12.0, 38.0
"""Distances up to which the integrand is searched: the first, and where it has not vanished there, the second. Beyond the
second, the normal density underflows."""
VANISHED = 1e-18
"""Share of the integral of absolute values in the last shell below which the search ends."""
RAYS, SPACING = 96, 0.25
"""Directions in which an integrand in the plane is searched, and distance of the points on a ray."""
NEGLIGIBLE = 1e-13
"""Share of the integral of absolute values beyond the limits that does not move the limits; the error includes it."""
MARGIN = 1.0
"""Distance of a moved limit from the last point with a share of the integral, in standard deviations."""
SHIFTS = {1: ((0.0, 0.5, 0.25, 0.75),), 2: ((0.0, 0.5, 0.25, 0.75), (0.0, 0.25, 0.75, 0.5))}
"""Shift of each rule's panels, as a share of a panel, by number of noise dimensions: no two rules share their points."""
COARSEST = {1: 512, 2: 12}
"""Panels per dimension of the coarsest rules, by number of noise dimensions."""
LEAST = {1: 1 << 15, 2: 1 << 17}
"""Fewest points, by number of noise dimensions. One: 1800 per standard deviation, enough for an event of width .001.
Two: 20 per standard deviation in each dimension."""
SETTLED = 1e-10
"""Relative error at which refinement stops."""
TOLERANCE = 1e-3
"""Relative error above which a rule with equal panels is not accepted."""
HALVINGS, SLOW, MOST, AROUND = 32, 20, 1 << 14, 256
"""Most halvings of a panel, halvings from which the error falls slowly, as at a pole, most panels that are halved together, and
panels around the largest cost."""
SEARCHED, SEARCH = 5.0, (1 << 11, 1 << 13)
"""Distance searched for narrow features on lines through w = 0, and panels of the coarse and the fine rule on a line."""
SKIPPED, LAST = 8, 5
"""First halvings of panels, whose changes show no power yet, and last changes, of which the largest is the error at a pole."""
DIVERGES, HEAVY = 0.95, 0.5
"""Fitted powers p of a pole 1 / distance^p from which on the mean may not exist (p = 1, less the error of the fit), and samples
have no variance."""
SOLVED = 1e-11
"""Relative error of costs of programs whose steps solve an equation to 1e-12."""
PROBES, STEP = 32, 1e-7
"""Number of stencils that measure the cost's rounding noise, and the spacing of their points in standard deviations."""


@dataclass(frozen=True)
class Integral:
    """A smoothed gradient ``(d,)``, the norm of its error, and the points used: their number and average spacing.

    ``note`` states a doubt that the integral exists. Where the doubt is not bounded, gradient and error are NaN.
    """

    gradient: np.ndarray
    error: float
    points: int
    spacing: float
    note: str = ""


class _NotFinite(Exception):
    """A cost within the limits of integration is not finite."""


@dataclass(frozen=True)
class _Integrand:
    """The integrand [f(w) - f(0)] w / sigma of a problem at ``theta (d,)``."""

    problem: Problem
    theta: np.ndarray

    @property
    def width(self) -> int:
        """Number of noise dimensions."""
        return self.problem.program.n_noise

    @cached_property
    def centre(self) -> float:
        """The cost f(0). As E[w] = 0, subtracting it does not change the integral, and loses fewer digits."""
        return float(self.problem.value(self.theta, np.zeros((self.width, 1)))[0])

    def cost(self, nodes: np.ndarray) -> np.ndarray:
        """Return f(w) at ``nodes (width, B)``: ``(B,)``."""
        return in_columns(lambda w: self.problem.value(self.theta, w), nodes, N_COLUMNS)

    def excess(self, nodes: np.ndarray) -> np.ndarray:
        """Return f(w) - f(0) at ``nodes (width, B)``: ``(B,)``."""
        return self.cost(nodes) - self.centre

    def edges(self, limits: _Limits) -> list[np.ndarray]:
        """Return per axis the limits and the scene's breakpoints between them, in standard deviations."""
        breaks, edges = self.problem.program.breakpoints(), []
        for i, (low, high) in enumerate(zip(limits.low, limits.high, strict=True)):
            inner = [(b - self.theta[i]) / self.problem.sigma for b in (breaks[i] if i < len(breaks) else ())]
            edges.append(np.unique([low, *(b for b in inner if low < b < high), high]))
        return edges

    def along(self, peak: np.ndarray, axis: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return f(w) - f(0) on the line through ``peak (width,)`` along ``axis (width,)``, at distances ``t (B,)``."""
        return self.excess(peak[:, None] + np.outer(axis, t))

    def unknown(self, note: str, points: int = 0, spacing: float = 0.0) -> Integral:
        """Return an integral without a value."""
        return Integral(np.full(self.problem.dim, math.nan), math.nan, points, spacing, note)


@dataclass(frozen=True)
class _Level:
    """The mean of four shifted rules with about equal panels, and what their points show of the integrand."""

    mean: np.ndarray
    spread: float
    """Largest distance of a rule from the mean."""
    points: int
    size: float
    """Norm of the largest integral of absolute values."""
    densest: float
    """Largest value of |f(w) - f(0)| exp(-|w|^2 / 2)."""
    peak: np.ndarray
    """The point ``(width,)`` of that value."""
    change: float = math.inf
    """Change of the mean from the level before."""

    @property
    def error(self) -> float:
        """The stated error of the mean, before rounding."""
        return max(2.0 * self.spread, self.change)

    @property
    def norm(self) -> float:
        """The norm of the mean."""
        return float(np.linalg.norm(self.mean))

    def after(self, coarser: _Level) -> _Level:
        """Return this level with its change from a coarser one, and with the sizes and the peak that both show."""
        peak = self if self.densest > coarser.densest else coarser
        change = float(np.linalg.norm(self.mean - coarser.mean))
        size = max(self.size, coarser.size)
        return replace(self, change=change, size=size, densest=peak.densest, peak=peak.peak)


def integrate(problem: Problem, theta: np.ndarray, points: int) -> Integral | None:
    """Return the smoothed gradient E[(f(w) - f(0)) w] / sigma for one- or two-dimensional noise on theta, by quadrature.

    Gauss-Legendre panels lie between the scene's breakpoints and are halved until the error is negligible or the next
    level would exceed ``points`` points. Every level averages four rules, shifted against each other. The stated error
    is twice the largest distance of a rule from the mean, or the change of the mean under the last halving if that is
    larger, plus rounding: the cost's measured noise, and 1e-11 of its size where steps solve equations. The limits
    of integration are where the integrand has vanished, see :func:`_limits`, and the error includes the remainder
    beyond them. Returns None where two levels, the last of at least :data:`LEAST` points, do not fit, or a cost within
    the limits is not finite. A feature of the cost that is narrower than the spacing and not among the breakpoints is
    missed.
    """
    integrand, sigma = _Integrand(problem, theta), problem.sigma
    width, limits = integrand.width, _limits(integrand.excess, integrand.width)
    if math.isnan(limits.beyond):
        return integrand.unknown(limits.note)
    edges = integrand.edges(limits)
    rounding = _noise(integrand.cost, width) * math.sqrt(width) / sigma
    try:
        level = _refined(integrand, edges, limits.stretch, points, rounding)
    except _NotFinite:
        # samples would miss what limits wider than usual contain
        wide = "costs far in the tails are not finite, so the mean may not exist"
        return integrand.unknown(limits.note or wide) if limits.stretch.max() > 1.0 else None
    if level is None or level.points < LEAST[width] or not math.isfinite(level.error + rounding):
        return None
    return _integral(integrand, edges, limits, level, rounding)


def _integral(
    integrand: _Integrand, edges: list[np.ndarray], limits: _Limits, level: _Level, rounding: float
) -> Integral:
    """Return the integral of the last level, after a search for what is narrower than its panels: features, and poles."""
    width, sigma = integrand.width, integrand.problem.sigma
    missed = _missed(integrand.excess, edges) / sigma if width > 1 or _has_settled(level, rounding) else 0.0
    allowed = min(level.error, TOLERANCE * level.norm) + SETTLED * level.norm + rounding + SOLVED * level.size
    is_missing = missed > allowed
    mean, error, used, power = level.mean, level.error, level.points, 0.0
    if width == 1 and (is_missing or error > TOLERANCE * level.norm):
        # halving only the panels that change resolves a narrow feature, which is then no longer missed
        ends = np.unique([*edges[0], *np.linspace(limits.low[0], limits.high[0], 2 * SEARCH[1])])
        value, error, used, power = _bisected(lambda t: t * integrand.excess(t[None, :]) / sigma, ends)
        mean, is_missing = np.array([value]), False
    elif error > SETTLED * level.norm:
        # an error that halving has not settled may be due to a pole, whose power shows on lines through the largest cost
        lines = [partial(integrand.along, level.peak, axis) for axis in np.eye(width)]
        power = max(_bisected(line, np.linspace(-1.0, 1.0, AROUND))[3] for line in lines)
    spacing = float(np.prod(limits.high - limits.low)) ** (1.0 / width) / used ** (1.0 / width)
    if power > DIVERGES:
        place = ", ".join(f"{x:.6g}" for x in integrand.theta[:width] + sigma * level.peak)
        return integrand.unknown(
            f"the cost is infinite near theta = ({place}), a pole, so its mean may not exist", used, spacing
        )
    doubts = [limits.note] if limits.note else []
    # the error falls as spacing^(1 - power), so a halving shows only a part of it
    error /= 2.0 ** (1.0 - power) - 1.0
    if is_missing:
        error += missed
        doubts.append("the cost has a feature narrower than the spacing of the points")
    if power >= HEAVY:
        doubts.append(f"the cost grows as 1 / distance^{power:.2g}, so samples have no variance")
    # the integral of absolute values has a relative rounding error of some unit roundoffs: each node's weight has a few
    solved = SOLVED if integrand.problem.program.needs_root else 64.0 * np.finfo(float).eps
    error += limits.beyond / sigma + rounding + solved * level.size
    return Integral(mean, error, used, spacing, "; ".join(doubts))


def _refined(
    integrand: _Integrand, edges: list[np.ndarray], stretch: np.ndarray, points: int, rounding: float
) -> _Level | None:
    """Return the first level that has settled, or the last of at most ``points`` points; None if there is none.

    Raises :class:`_NotFinite`.
    """
    panels, level = COARSEST[integrand.width], None
    while True:
        rules = _rules(edges, panels * stretch)
        if sum(math.prod(axis[0].size for axis in axes) for axes in rules) > points:
            return level
        finer = _level(integrand, rules)
        level = finer if level is None else finer.after(level)
        if level.points >= LEAST[integrand.width] and _has_settled(level, rounding):
            return level
        panels *= 2


def _has_settled(level: _Level, rounding: float) -> bool:
    return level.error <= SETTLED * level.norm + rounding


def _level(integrand: _Integrand, rules: list[tuple[tuple[np.ndarray, np.ndarray], ...]]) -> _Level:
    """Return the level of some rules; raises :class:`_NotFinite`."""
    problem, gradients, points, size, densest, peak = integrand.problem, [], 0, 0.0, 0.0, np.zeros(integrand.width)
    for axes in rules:
        nodes, weights = (
            np.stack([part.ravel() for part in np.meshgrid(*each, indexing="ij")]) for each in zip(*axes, strict=True)
        )
        f, weights = integrand.cost(nodes), weights.prod(axis=0)
        if not np.isfinite(f).all():
            raise _NotFinite
        w, points = nodes[: problem.dim], points + f.size
        gradients.append(w @ (weights * (f - integrand.centre)) / problem.sigma)
        size = max(size, float(np.linalg.norm(np.abs(w) @ (weights * np.abs(f))) / problem.sigma))
        dense = np.abs(f - integrand.centre) * np.exp(-np.square(nodes).sum(axis=0) / 2)
        if dense.max() > densest:
            densest, peak = float(dense.max()), nodes[:, np.argmax(dense)]
    mean = np.mean(gradients, axis=0)
    spread = max(float(np.linalg.norm(gradient - mean)) for gradient in gradients)
    return _Level(mean, spread, points, size, densest, peak)


@dataclass(frozen=True)
class _Limits:
    """Limits of integration per axis, ``(width,)``."""

    low: np.ndarray
    high: np.ndarray
    beyond: float
    """Bound on the integral of |f(w) - f(0)| |w| beyond the limits; NaN where all limits are too narrow."""
    note: str

    @property
    def stretch(self) -> np.ndarray:
        """Distance of the limits per axis, relative to the least one, ``(width,)``."""
        return (self.high - self.low) / (2.0 * LEAST_LIMIT)


@dataclass(frozen=True)
class _Shells:
    """The mass |f(w) - f(0)| |w| times the normal density, on rays from w = 0."""

    points: np.ndarray
    """The points ``(width, rays, radii)``."""
    mass: np.ndarray
    """The mass of the shell at each point, ``(rays, radii)``; 0 from a ray's first point on that is not finite."""
    ended: np.ndarray
    """Whether the ray has ended, ``(rays, radii)``."""

    @property
    def last(self) -> np.ndarray:
        """Index of the last finite point of each ray, -1 where it has none, ``(rays,)``."""
        return np.where(self.ended.any(axis=1), self.ended.argmax(axis=1) - 1, self.mass.shape[1] - 1)

    def unseen(self) -> float:
        """Return the mass beyond rays that end far out.

        Shells are taken to fall at least as fast as the last two, as a geometric series; the sum is infinite or NaN
        where these do not fall.
        """
        ray, last = np.arange(len(self.mass)), self.last
        at_end, before = self.mass[ray, last.clip(0)], self.mass[ray, (last - 1).clip(0)]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = at_end / np.maximum(before, at_end)
            rest = np.where(at_end > VANISHED * float(self.mass.sum()), at_end * ratio / (1.0 - ratio), 0.0)
        return float(rest[SPACING * (last.clip(0) + 1) >= LEAST_LIMIT].sum())


def _limits(excess: OfColumns, width: int) -> _Limits:
    """Return the limits of integration for ``excess (width, B) -> (B,)``, the cost minus that at 0.

    Points on rays up to 38 standard deviations show where the integrand has mass, such as the mean of exp(8 w), which
    comes from w around 8. All limits are too narrow where the integrand has not vanished at a ray's last finite point.
    """
    shells = _shells(excess, width)
    points, mass, total = shells.points, shells.mass, float(shells.mass.sum())
    low, high = np.full(width, -LEAST_LIMIT), np.full(width, LEAST_LIMIT)
    beyond = float(mass[np.abs(points).max(axis=0) > LEAST_LIMIT].sum())
    if beyond > NEGLIGIBLE * total:
        # what each point and all points farther out on its ray contribute
        rest = np.cumsum(mass[:, ::-1], axis=1)[:, ::-1]
        inside, finite = points[:, rest > NEGLIGIBLE * total / len(mass)], points[:, ~shells.ended]
        low = np.maximum(np.minimum(low, inside.min(axis=1) - MARGIN), finite.min(axis=1))
        high = np.minimum(np.maximum(high, inside.max(axis=1) + MARGIN), finite.max(axis=1))
        is_outside = (points < low[:, None, None]) | (points > high[:, None, None])
        beyond = float(mass[is_outside.any(axis=0)].sum())
    unseen, nearest, note = shells.unseen(), SPACING * (shells.last.min() + 1), ""
    if shells.ended.any() and nearest >= LEAST_LIMIT:
        note = f"costs beyond {nearest:g} standard deviations are not finite, so the mean may not exist"
    # with a larger share of the mass beyond the last finite points, the integral may not exist
    if unseen > 1e-3 * total:
        return _Limits(
            low, high, math.nan, note or "the cost grows as fast as the normal density falls, so its mean may not exist"
        )
    return _Limits(low, high, 2.0 * (beyond + unseen), note)


def _shells(excess: OfColumns, width: int) -> _Shells:
    """Return the mass on rays, as far out as it has vanished."""
    turn = 2.0 * math.pi * (np.arange(RAYS) + 0.5) / RAYS
    rays = np.array([[-1.0, 1.0]]) if width == 1 else np.stack([np.cos(turn), np.sin(turn)])
    for farthest in (NEAR, FARTHEST):
        radii = SPACING * np.arange(1, round(farthest / SPACING) + 1)
        points = rays[:, :, None] * radii
        with np.errstate(all="ignore"):
            f = np.abs(excess(points.reshape(width, -1))).reshape(points.shape[1:])
            # per ray, the share of each shell: the area of its sector times the normal density
            shell = SPACING * radii ** (width - 1) * np.exp(-(radii**2) / 2) / math.sqrt(2.0 * math.pi) ** width
            mass = f * radii * shell * (2.0 * math.pi / RAYS if width == 2 else 1.0)
        if mass[:, -1].sum() <= VANISHED * mass.sum():
            break
    # a ray ends at its first point that is not finite
    ended = np.logical_or.accumulate(~np.isfinite(mass), axis=1)
    return _Shells(points, np.where(ended, 0.0, mass), ended)


def _missed(excess: OfColumns, edges: list[np.ndarray]) -> float:
    """Return the largest change, from coarse to fine panels, of E[f(w) w] along an axis or a diagonal through w = 0.

    The lines show what may lie between the points of a rule, such as a narrow ridge. ``edges`` are those of each axis.
    """
    half, changes = math.sqrt(0.5), []
    for line in [(1.0,)] if len(edges) == 1 else [(1.0, 0.0), (0.0, 1.0), (half, half), (half, -half)]:
        crossed = np.concatenate([each / part for each, part in zip(edges, line, strict=True) if part])
        ends = np.unique([-SEARCHED, *crossed[np.abs(crossed) < SEARCHED], SEARCHED])
        rules = [_panels(ends, panels, 0.0) for panels in SEARCH]
        coarse, fine = (float(weights * t @ excess(np.outer(line, t))) for t, weights in rules)
        changes.append(abs(fine - coarse))
    return max(changes)


def _bisected(integrand: OfColumns, ends: np.ndarray) -> tuple[float, float, int, float]:
    """Return the mean of ``integrand (B,) -> (B,)`` under the normal density, its last change, the points used, and a power.

    Panels between ``ends`` that change when they are halved are halved again, so that spikes, jumps and poles are
    resolved. At a pole 1 / distance^p, the changes of successive halvings fall by the ratio 2^(p - 1), whose fit shows the
    power p. It is 0 where changes are rounding after :data:`SLOW` halvings.
    """
    x, w = np.polynomial.legendre.leggauss(NODES)

    def panels(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        half = (high - low)[:, None] / 2.0
        t = (low[:, None] + half) + half * x
        weights = half * w * np.exp(-(t**2) / 2.0) / math.sqrt(2.0 * math.pi)
        return (weights * integrand(t.ravel()).reshape(t.shape)).sum(axis=1)

    low, high = ends[:-1], ends[1:]
    whole, total, used, changes = panels(low, high), 0.0, low.size * NODES, []
    size, closed = float(np.abs(whole).sum()), 0.0
    limit = SOLVED * size
    while True:
        middle = (low + high) / 2.0
        parts = np.stack([panels(low, middle), panels(middle, high)])
        size = max(size, float(np.abs(parts[np.isfinite(parts)]).sum()))
        used += 2 * low.size * NODES
        change = np.abs(parts.sum(axis=0) - whole)
        changes.append(float(change.sum()))
        is_open = change > limit
        if len(changes) == HALVINGS or is_open.sum() > MOST:
            is_open[:] = False
        total += float(parts[:, ~is_open].sum())
        closed += float(change[~is_open].sum())
        if not is_open.any():
            break
        low, high = np.concatenate([low[is_open], middle[is_open]]), np.concatenate([middle[is_open], high[is_open]])
        whole = parts[:, is_open].ravel()
    power, tail = 0.0, np.array(changes[SKIPPED:])
    # the first panels may have missed a spike: halvings then go on until rounding alone changes it. Any one change may vanish
    # by chance, or be infinite where a node meets the pole
    at = np.flatnonzero(np.isfinite(tail) & (tail > SOLVED * size))
    if at.size and at[-1] + SKIPPED >= SLOW:
        closed = max(closed, *tail[at[-LAST:]])
        power = max(1.0 + float(np.polyfit(at, np.log2(tail[at]), 1)[0]), 0.0)
    return total, closed, used, power


def _rules(edges: list[np.ndarray], counts: np.ndarray) -> list[tuple[tuple[np.ndarray, np.ndarray], ...]]:
    """Return the rules with about ``counts`` panels per axis, each as nodes and weights by axis."""
    shifts = zip(edges, counts, SHIFTS[len(edges)], strict=True)
    return [*zip(*([_panels(e, round(n), shift) for shift in each] for e, n, each in shifts), strict=True)]


def _panels(edges: np.ndarray, count: int, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights (normal density included) of about ``count`` panels, shifted by ``shift`` of a panel."""
    x, w = np.polynomial.legendre.leggauss(NODES)
    cuts = [edges]
    for a, b in itertools.pairwise(edges):
        share = max(1, round(count * (b - a) / (edges[-1] - edges[0])))
        cuts.append(a + (b - a) * (np.arange(share) + shift) / share)
    ends = np.unique(np.concatenate(cuts))
    half = np.diff(ends)[:, None] / 2
    nodes = ((ends[:-1, None] + half) + half * x).ravel()
    return nodes, (half * w).ravel() * np.exp(-(nodes**2) / 2) / math.sqrt(2 * math.pi)


def _noise(cost: OfColumns, width: int) -> float:
    """Return a bound on the cost's rounding noise, from fourth differences over stencils too short to show its shape.

    The fourth difference of independent errors of variance s^2 has the variance 70 s^2. A stencil that contains a kink
    or a jump is rare, and only makes the bound larger.
    """
    # the stencils are evenly spread over a disc of three standard deviations, away from round numbers
    turn = np.arange(PROBES)
    radius = 3.0 * np.sqrt((turn + 0.5) / PROBES)
    at = np.stack([radius * np.cos(2.4 * turn), radius * np.sin(2.4 * turn)])[:width]
    stencil = at[:, :, None] + STEP * np.arange(5)
    f = cost(stencil.reshape(width, -1)).reshape(PROBES, 5)
    differences = np.diff(f, 4, axis=1)
    if not np.isfinite(differences).all():
        return math.inf
    return 4.0 * math.sqrt(float((differences**2).mean()) / 70.0)
