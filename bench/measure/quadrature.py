"""Computes smoothed gradients by quadrature, with an error from the disagreement of several rules."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bench.measure.batches import in_columns
from bench.model import Problem

NODES = 8
"""Number of Gauss-Legendre nodes per panel."""
REACH = 9.0
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
FIRST = {1: 512, 2: 12}
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
SOLVED = 1e-11
"""Relative error of costs of programs whose steps solve an equation to 1e-12."""
ROUNDED = 64.0
"""Relative rounding error of the integral of absolute values, in unit roundoffs: a node's weight has a few."""
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


def integrate(problem: Problem, theta: np.ndarray, points: int, columns: int) -> Integral | None:
    """Return the smoothed gradient E[(f(w) - f(0)) w] / sigma for one- or two-dimensional noise on theta, by quadrature.

    Gauss-Legendre panels lie between the scene's breakpoints and are halved until the error is negligible or the next
    level would exceed ``points`` points. Every level averages four rules, shifted against each other. The stated error
    is twice the largest distance of a rule from the mean, or the change of the mean under the last halving if that is
    larger, plus rounding: the cost's measured noise, and 1e-11 of its size where steps solve equations. The limits
    of integration are where the integrand has vanished, see :func:`_limits`, and the error includes the remainder
    beyond them. Returns None where two levels, the last of at least :data:`LEAST` points, do not fit, or a cost within
    the limits is not finite. A feature of the cost that is narrower than the spacing and not among the breakpoints is
    missed. The cost is evaluated ``columns`` points at a time.
    """
    width, dim, sigma = problem.program.n_noise, problem.dim, problem.sigma
    # E[w] = 0, so subtracting f(0) does not change the integral, and loses fewer digits
    centre = problem.value(theta, np.zeros((width, 1)))[0]

    def cost(nodes: np.ndarray) -> np.ndarray:
        return in_columns(lambda w: problem.value(theta, w), nodes, columns)

    def excess(nodes: np.ndarray) -> np.ndarray:
        return cost(nodes) - centre

    def unknown(note: str, points: int = 0, spacing: float = 0.0) -> Integral:
        return Integral(np.full(dim, math.nan), math.nan, points, spacing, note)

    low, high, beyond, note = _limits(excess, width)
    if math.isnan(beyond):
        return unknown(note)
    edges, breaks = [], problem.program.breakpoints()
    for i in range(width):
        inner = [(b - theta[i]) / sigma for b in (breaks[i] if i < len(breaks) else ())]
        edges.append(np.unique([low[i], *(b for b in inner if low[i] < b < high[i]), high[i]]))
    stretch = (high - low) / (2.0 * REACH)
    rounding = _noise(cost, width) * math.sqrt(width) / sigma
    panels, mean, error, used, size, largest, peak = FIRST[width], None, math.inf, 0, 0.0, 0.0, np.zeros(width)
    while True:
        rules = _rules(edges, panels * stretch)
        count = sum(math.prod(axis[0].size for axis in axes) for axes in rules)
        if count > points:
            break
        gradients = []
        for axes in rules:
            nodes, weights = (
                np.stack([part.ravel() for part in np.meshgrid(*each, indexing="ij")])
                for each in zip(*axes, strict=True)
            )
            f, weights = cost(nodes), weights.prod(axis=0)
            if not np.isfinite(f).all():
                # samples would miss what limits wider than usual contain
                wide = "costs far in the tails are not finite, so the mean may not exist"
                return unknown(note or wide) if stretch.max() > 1.0 else None
            dense = np.abs(f - centre) * np.exp(-np.square(nodes).sum(axis=0) / 2)
            if dense.max() > largest:
                peak, largest = nodes[:, np.argmax(dense)], float(dense.max())
            gradients.append(nodes[:dim] @ (weights * (f - centre)) / sigma)
            size = max(size, float(np.linalg.norm(np.abs(nodes[:dim]) @ (weights * np.abs(f))) / sigma))
        before, mean, used = mean, np.mean(gradients, axis=0), count
        spread = max(float(np.linalg.norm(gradient - mean)) for gradient in gradients)
        # stated error, as a multiple of the largest distance of a rule from the mean of all rules
        error = max(2.0 * spread, math.inf if before is None else float(np.linalg.norm(mean - before)))
        if count >= LEAST[width] and error <= SETTLED * np.linalg.norm(mean) + rounding:
            break
        panels *= 2
    if mean is None or used < LEAST[width] or not math.isfinite(error + rounding):
        return None
    spacing = float(np.prod(high - low)) ** (1.0 / width) / used ** (1.0 / width)
    norm, power, missed, doubts = float(np.linalg.norm(mean)), 0.0, 0.0, [note] if note else []
    if width > 1 or error <= SETTLED * norm + rounding:
        missed = _missed(excess, edges) / sigma
    is_narrow = missed > min(error, TOLERANCE * norm) + SETTLED * norm + rounding + SOLVED * size
    if width == 1 and (is_narrow or error > TOLERANCE * norm):
        ends = np.unique([*edges[0], *np.linspace(low[0], high[0], 2 * SEARCH[1])])
        value, error, used, power = _bisected(lambda t: t * excess(t[None, :]) / sigma, ends)
        mean, spacing, is_narrow = np.array([value]), float(high[0] - low[0]) / used, False
    elif error > SETTLED * norm:
        # along each axis, the power with which the cost grows near its largest value
        lines = [lambda t, axis=axis: excess(peak[:, None] + np.outer(axis, t)) for axis in np.eye(width)]
        power = max(_bisected(line, np.linspace(-1.0, 1.0, AROUND))[3] for line in lines)
    # least power p of a pole, where the cost grows as 1 / distance^p. From p = 1 on, its integral over a line
    # diverges
    if power > 0.95:
        place = ", ".join(f"{x:.6g}" for x in theta[:width] + sigma * peak)
        return unknown(f"the cost is infinite near theta = ({place}), a pole, so its mean may not exist", used, spacing)
    # the error falls as spacing^(1 - p), so a halving shows only a part of it
    error /= 2.0 ** (1.0 - power) - 1.0
    if is_narrow:
        error += missed
        doubts.append("the cost has a feature narrower than the spacing of the points")
    if power >= 0.5:
        doubts.append(f"the cost grows as 1 / distance^{power:.2g}, so samples have no variance")
    solved = SOLVED if problem.program.needs_root else ROUNDED * np.finfo(float).eps
    error += beyond / sigma + rounding + solved * size
    return Integral(mean, error, used, spacing, "; ".join(doubts))


def _limits(excess: Callable[[np.ndarray], np.ndarray], width: int) -> tuple[np.ndarray, np.ndarray, float, str]:
    """Return the limits of integration ``(width,)`` for ``excess (width, B) -> (B,)``, the cost minus that at 0.

    Points on rays up to 38 standard deviations show where |cost| |w| times the normal density has mass, such as the
    mean of exp(8 w), which comes from w around 8. The third value bounds the integral of the absolute integrand beyond
    the limits. It is NaN where the integrand has not vanished at the last finite point of a ray: all limits are too
    narrow. The fourth value is a note, or an empty string.
    """
    turn = 2.0 * math.pi * (np.arange(RAYS) + 0.5) / RAYS
    rays = np.array([[-1.0, 1.0]]) if width == 1 else np.stack([np.cos(turn), np.sin(turn)])
    for farthest in (NEAR, FARTHEST):
        radii = SPACING * np.arange(1, round(farthest / SPACING) + 1)
        points = (rays[:, :, None] * radii).reshape(width, -1)
        with np.errstate(all="ignore"):
            f = np.abs(excess(points)).reshape(rays.shape[1], radii.size)
            # per ray, the share of each shell: the area of its sector times the normal density
            shell = SPACING * radii ** (width - 1) * np.exp(-(radii**2) / 2) / math.sqrt(2.0 * math.pi) ** width
            mass = f * radii * shell * (2.0 * math.pi / RAYS if width == 2 else 1.0)
        if mass[:, -1].sum() <= VANISHED * mass.sum():
            break
    # a ray ends at its first point that is not finite
    ended = np.logical_or.accumulate(~np.isfinite(mass), axis=1)
    mass = np.where(ended, 0.0, mass)
    total = float(mass.sum())
    low, high = np.full(width, -REACH), np.full(width, REACH)
    outside = np.abs(points).max(axis=0).reshape(mass.shape) > REACH
    beyond = float(mass[outside].sum())
    if beyond > NEGLIGIBLE * total:
        # what each point and all points farther out on its ray contribute
        rest = np.cumsum(mass[:, ::-1], axis=1)[:, ::-1]
        inside = points[:, (rest > NEGLIGIBLE * total / rays.shape[1]).ravel()]
        finite = points[:, ~ended.ravel()]
        low = np.maximum(np.minimum(low, inside.min(axis=1) - MARGIN), finite.min(axis=1))
        high = np.minimum(np.maximum(high, inside.max(axis=1) + MARGIN), finite.max(axis=1))
        outside = ((points < low[:, None]) | (points > high[:, None])).any(axis=0).reshape(mass.shape)
        beyond = float(mass[outside].sum())
    note = ""
    last = np.where(ended.any(axis=1), ended.argmax(axis=1) - 1, radii.size - 1)
    ray = np.arange(last.size)
    at_end, before = mass[ray, last.clip(0)], mass[ray, (last - 1).clip(0)]
    # beyond the last finite point, shells fall at least as fast as the last two, as a geometric series
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = at_end / np.maximum(before, at_end)
        unseen = np.where(at_end > VANISHED * total, at_end * ratio / (1.0 - ratio), 0.0)[radii[last.clip(0)] >= REACH]
    if ended.any() and radii[last.min()] >= REACH:
        note = f"costs beyond {radii[last.min()]:g} standard deviations are not finite, so the mean may not exist"
    # share of the integral of absolute values at the last finite point of a ray above which the integral may
    # not exist
    if float(unseen.sum()) > 1e-3 * total:
        note = note or "the cost grows as fast as the normal density falls, so its mean may not exist"
        return low, high, math.nan, note
    return low, high, 2.0 * (beyond + float(unseen.sum())), note


def _missed(excess: Callable[[np.ndarray], np.ndarray], edges: list[np.ndarray]) -> float:
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


def _bisected(integrand: Callable[[np.ndarray], np.ndarray], ends: np.ndarray) -> tuple[float, float, int, float]:
    """Return the mean of ``integrand (B,) -> (B,)`` under the normal density, its last change, the points used, and a power.

    Panels between ``ends`` that change when they are halved are halved again, so that spikes, jumps and poles are
    resolved. At a pole 1 / distance^p, the changes of successive halvings fall by the ratio 2^(p - 1), whose fit shows the
    power p. It is 0 where changes vanish within :data:`SLOW` halvings.
    """
    x, w = np.polynomial.legendre.leggauss(NODES)

    def panels(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        half = (high - low)[:, None] / 2.0
        t = (low[:, None] + half) + half * x
        weights = half * w * np.exp(-(t**2) / 2.0) / math.sqrt(2.0 * math.pi)
        return (weights * integrand(t.ravel()).reshape(t.shape)).sum(axis=1)

    low, high = ends[:-1], ends[1:]
    whole, total, used, changes = panels(low, high), 0.0, low.size * NODES, []
    limit, closed = SOLVED * float(np.abs(whole).sum()), 0.0
    while True:
        middle = (low + high) / 2.0
        parts = np.stack([panels(low, middle), panels(middle, high)])
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
    power = 0.0
    if len(changes) > SLOW:
        # any one change may vanish by chance, or be infinite where a node meets the pole
        tail = np.array(changes[8:])
        at = np.flatnonzero(np.isfinite(tail) & (tail > 0.0))
        closed = max(closed, *tail[at[-5:]])
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


def _noise(cost: Callable[[np.ndarray], np.ndarray], width: int) -> float:
    """Return a bound on the cost's rounding noise, from fourth differences over stencils too short to show its shape.

    The fourth difference of independent errors of variance s^2 has the variance 70 s^2. A stencil that contains a kink
    or a jump is rare, and only makes the bound larger.
    """
    # evenly spread over a disc of three standard deviations, away from round numbers
    turn = np.arange(PROBES)
    radius = 3.0 * np.sqrt((turn + 0.5) / PROBES)
    at = np.stack([radius * np.cos(2.4 * turn), radius * np.sin(2.4 * turn)])[:width]
    stencil = at[:, :, None] + STEP * np.arange(5)
    f = cost(stencil.reshape(width, -1)).reshape(PROBES, 5)
    differences = np.diff(f, 4, axis=1)
    if not np.isfinite(differences).all():
        return math.inf
    return 4.0 * math.sqrt(float((differences**2).mean()) / 70.0)
