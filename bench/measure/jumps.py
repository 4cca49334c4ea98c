"""Finds what is wrong with the mean of gradients under noise: samples without a number, jumps of the cost, slopes that no sample meets."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from bench.measure.batches import in_columns
from bench.model import Problem
from bench.model.blocks import OfColumns

PARTS = 64
"""Default number of intervals of each line at the first level."""
FINEST = 1e-11
"""Interval length, as a share of the line, at which a change of the cost that no longer shrinks is a jump."""
LOUD = 100.0
"""Multiple of the cost's rounding noise below which a change counts as noise."""
SINGLE = float(np.finfo(np.float32).eps)
"""Relative rounding of a cost computed in single precision, whose values are all single-precision numbers."""
MOST_POINTS = 1 << 25
"""Most numbers in the points of one call of the cost (256 MiB)."""
REACH = 4.0
"""Distance searched on either side of theta, in standard deviations of the noise."""
LINES = 16
"""Most lines along coordinates, and along random directions; twice as many lie between two random samples."""
FAR, NODES = 6.0, 128
"""Distance on either side of theta, in standard deviations, and number of points, of the lines with costs and gradients."""
MET = 3.0
"""Distance that samples are sure to meet: one in 370 is beyond it."""
SIGNED = 5
"""Largest number of inputs of which all diagonals are lines."""
MISSED = 0.25
"""Share of the mean slope that gradients must not miss: half of the error at which an estimate counts as wrong."""
SAMPLES = 512
"""Samples of the noise whose costs and gradients must be numbers: an event of 1% is in all but one of 170 such sets."""


class Jump(NamedTuple):
    """The largest jump of a cost on some lines."""

    height: float
    """Change of the cost across the jump; 0 without a jump."""
    span: float
    """Range of the cost on the lines."""
    line: int = 0
    """Index of the line with the jump."""
    at: float = 0.0
    """Place of the jump on its line, from 0 at the start to 1 at the end."""


class Lost(NamedTuple):
    """What is lost of the mean of gradients: samples that are NaN or infinite, or a part of the mean slope along a line."""

    share: float
    """Share of the samples, or of the largest mean slope of all lines; 0 where nothing is lost."""
    w: np.ndarray
    """The noise ``(n_w,)`` of the sample nearest to theta, or where most of the slope lies; 0 where nothing is lost."""


class Sampled(NamedTuple):
    """What :data:`SAMPLES` samples of the noise show of costs and gradients."""

    gradients: Lost
    """Samples whose cost is a number, and whose gradient is not."""
    costs: Lost
    spread: float
    """Standard deviation of one gradient over the norm of their mean; infinite where that is not distinguishable from 0."""


def sampled_gradients(problem: Problem, theta: np.ndarray, seed: int, columns: int) -> Sampled:
    """Return what samples of the noise show of costs and gradients at ``theta (d,)``."""
    w = np.random.default_rng([seed, 0x6C6F7374]).standard_normal((problem.program.n_noise, SAMPLES))
    with np.errstate(all="ignore"):
        found = _costs_and_gradients(problem, theta, w, columns)
        variance = float(found[1:].var(axis=1, ddof=1).sum())
        square = float(np.square(found[1:].mean(axis=1)).sum()) - variance / SAMPLES
        spread = math.sqrt(variance / square) if square > 0.0 and math.isfinite(variance) else math.inf
    has_cost, has_gradient = np.isfinite(found[0]), np.isfinite(found[1:]).all(axis=0)
    order = np.argsort(np.linalg.norm(w, axis=0))

    def lost(bad: np.ndarray) -> Lost:
        nearest = order[bad[order]][:1]
        return Lost(float(bad.mean()), w[:, nearest[0]] if nearest.size else np.zeros(len(w)))

    return Sampled(lost(has_cost & ~has_gradient), lost(~has_cost), spread)


def _costs_and_gradients(problem: Problem, theta: np.ndarray, w: np.ndarray, columns: int) -> np.ndarray:
    """Return costs and gradients at ``theta (d,)`` under noise ``w (n_w, B)``, ``(1 + d, B)``."""

    def both(part: np.ndarray) -> np.ndarray:
        # one theta per column, the shape that a compiling backend has compiled for differences
        at = np.repeat(theta[:, None], part.shape[1], axis=1)
        return np.concatenate([problem.value(at, part)[None], problem.grad(at, part)])

    return in_columns(both, w, columns)


def missed_slope(problem: Problem, theta: np.ndarray, seed: int, columns: int) -> Lost:
    """Return the slope of the mean cost at ``theta (d,)`` that sampled gradients miss, on lines through its noise.

    On a line, the derivative of the mean cost is E[f(t) t] for a standard normal t, from costs, and E[f'(t)] from
    gradients. Samples meet only t within :data:`MET`. The two differ where a rise is too narrow for any sample, or where
    a far kink or a jump has a large weight. They show nothing where sums over every other point differ as well, as in
    chaos. Only noise that acts on theta has gradients along a line; the share is 0 for other noise.
    """
    width, dim = problem.program.n_noise, problem.dim
    nothing = Lost(0.0, np.zeros(width))
    if not problem.noise_on_theta or not problem.sigma > 0.0:
        return nothing
    directions = _lines_of_slopes(dim, np.random.default_rng([seed, 0x736C6F70]))
    t = np.linspace(-FAR, FAR, NODES)
    points = np.zeros((width, directions.shape[1] * NODES))
    points[:dim] = (directions[:, :, None] * t).reshape(dim, -1)
    with np.errstate(all="ignore"):
        both = _costs_and_gradients(problem, theta, points, columns).reshape(dim + 1, -1, NODES)
        costs, slopes = both[0], np.einsum("dl,dlt->lt", directions, problem.sigma * both[1:])
        density = np.exp(-t * t / 2.0) / np.sqrt(2.0 * np.pi) * (t[1] - t[0])
        by_costs = (costs - costs[:, NODES // 2, None]) * t * density
        by_gradients = np.where(np.abs(t) <= MET, slopes, 0.0) * density
        missed = (by_costs - by_gradients).sum(axis=1)
        doubts = [
            2.0 * np.abs(part[:, ::2].sum(axis=1) - part[:, 1::2].sum(axis=1)) for part in (by_costs, by_gradients)
        ]
        largest = max(np.nanmax(np.abs(part.sum(axis=1)), initial=0.0) for part in (by_costs, by_gradients))
        unit = SINGLE if (costs == costs.astype(np.float32)).all() else float(np.finfo(np.float64).eps)
        noise = LOUD * unit * np.abs(costs).max(axis=1)
        # the sums decide if those over every other point differ little, relative to the missed slope
        is_shown = (np.abs(missed) > noise) & (doubts[1] <= 0.25 * np.abs(missed)) & (doubts[0] <= np.abs(missed))
        shares = np.where(is_shown, np.abs(missed) / largest, 0.0)
    line = int(np.argmax(shares))
    if not shares[line] > MISSED:
        return nothing
    rest = np.abs(np.diff(costs[line]) - (slopes[line, 1:] + slopes[line, :-1]) / 2.0 * (t[1] - t[0]))
    rest = np.where(np.abs(t[1:]) > MET, np.abs(np.diff(costs[line])), rest) * density[1:]
    w = np.zeros(width)
    w[:dim] = directions[:, line] * t[int(np.argmax(rest))]
    return Lost(float(shares[line]), w)


def coordinates(width: int, most: int) -> np.ndarray:
    """Return the unit vectors of at most ``most`` evenly spaced coordinates, ``(width, L)``."""
    chosen = np.unique(np.linspace(0, width - 1, min(width, most)).astype(int))
    units = np.zeros((width, chosen.size))
    units[chosen, np.arange(chosen.size)] = 1.0
    return units


def _lines_of_slopes(dim: int, random: np.random.Generator) -> np.ndarray:
    """Return unit vectors ``(d, L)``: coordinates, diagonals of pairs and of all inputs where there are few, random ones."""
    rows = list(coordinates(dim, LINES).T)
    if 1 < dim <= SIGNED:
        signs = np.array(np.meshgrid(*[(-1.0, 0.0, 1.0)] * dim)).reshape(dim, -1).T
        first = signs[np.arange(len(signs)), (signs != 0).argmax(axis=1)]
        rows += list(signs[(first > 0) & ((signs != 0).sum(axis=1) > 1)])
    elif dim > SIGNED:
        rows += [*np.sign(random.standard_normal((LINES, dim))), *random.standard_normal((LINES, dim))]
    directions = np.array(rows).T
    return directions / np.linalg.norm(directions, axis=0)


def jump_under_noise(problem: Problem, theta: np.ndarray, seed: int, columns: int) -> tuple[Jump, np.ndarray]:
    """Return the largest jump of the cost at ``theta (d,)`` on lines through its noise, and the jump's noise ``(n_w,)``.

    The mean of gradients misses a jump that the noise reaches, although each gradient is right. The lines go 4 standard
    deviations to either side of w = 0, along coordinates, random directions and the direction that changes the cost
    most, and between pairs of samples. The cost is evaluated ``columns`` samples at a time.
    """
    width = problem.program.n_noise
    random = np.random.default_rng([seed, 0x6A756D70])
    samples = random.standard_normal((width, 4 * LINES))

    def cost(w: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            # one theta per column, the shape that a compiling backend has compiled for differences
            return in_columns(lambda part: problem.value(np.repeat(theta[:, None], columns, axis=1), part), w, columns)

    changes = cost(samples)
    changes = np.where(np.isfinite(changes), changes - np.nan_to_num(np.median(changes)), 0.0)
    directions = np.concatenate([coordinates(width, LINES), samples[:, :LINES], (samples @ changes)[:, None]], axis=1)
    lengths = np.linalg.norm(directions, axis=0)
    directions = directions[:, lengths > 0.0] / lengths[lengths > 0.0]
    pairs = samples[:, : 2 * LINES], samples[:, 2 * LINES :]
    starts = np.concatenate([-REACH * directions, pairs[0]], axis=1)
    ends = np.concatenate([REACH * directions, pairs[1]], axis=1)
    jump = largest_jump(cost, starts, ends)
    return jump, starts[:, jump.line] + jump.at * (ends[:, jump.line] - starts[:, jump.line])


def largest_jump(cost: OfColumns, starts: np.ndarray, ends: np.ndarray, parts: int = PARTS) -> Jump:
    """Return the largest jump of ``cost`` on the lines from ``starts (n, L)`` to ``ends (n, L)``.

    ``cost`` maps points ``(n, B)`` to ``(B,)``. As intervals of length h shrink, the second difference of a smooth cost
    falls as h^2, at a kink as h, and at a jump it is constant. Three kinds of jumps are missed: jumps below 1e-6 of the
    cost's range on the lines, jumps between two of the first ``parts`` + 1 nodes of a line that do not change the cost
    at these nodes, and jumps in an interval whose second difference more than 32 other intervals exceed.
    Values that are not finite are ignored.
    """
    line = np.arange(starts.shape[1])
    left, width = np.zeros(line.size), 1.0
    span = size = 0.0
    single = True
    while True:
        nodes = left[:, None] + width * np.linspace(0.0, 1.0, parts + 1)
        values = _costs_at(cost, starts[:, line], ends[:, line], nodes)
        known = values[np.isfinite(values)]
        if not known.size:
            return Jump(0.0, span)
        single = single and bool((known == known.astype(np.float32)).all())
        size = max(size, float(np.abs(known).max()))
        span = max(span, float(np.ptp(known)))
        bends = np.nan_to_num(np.abs(np.diff(values, 2, axis=1)))
        if width / parts < FINEST:
            break
        row, place = np.unravel_index(np.argsort(bends, axis=None)[-32:], bends.shape)
        # the 32 most suspicious intervals and their neighbours are divided into as many at every further level
        line, left, width, parts = line[row], nodes[row, place], 2.0 * width / parts, 32
    # at this length only a jump exceeds rounding, whose steps are flat in single precision, so that they have no median bend
    noise = max(float(np.median(bends)), SINGLE * size * single)
    steps = np.nan_to_num(np.abs(np.diff(values, axis=1)))
    isolated = _isolated(values, steps)
    best = int(np.argmax(isolated))
    at, change = int(steps[best].argmax()), float(isolated[best])
    # below this share of the range of the cost on the lines rounding may hide that a change still shrinks
    is_jump = change > max(1e-6 * span, LOUD * noise)
    return Jump(change if is_jump else 0.0, span, int(line[best]), float(nodes[best, at : at + 2].mean()))


def _costs_at(cost: OfColumns, starts: np.ndarray, ends: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return the costs ``(L, P)`` at shares ``nodes`` of the way from ``starts (n, L)`` to ``ends``; NaN where not finite."""
    line, share = np.repeat(np.arange(len(nodes)), nodes.shape[1]), nodes.ravel()
    held = max(1, MOST_POINTS // len(starts))
    blocks = [slice(i, i + held) for i in range(0, share.size, held)]
    values = [
        cost(starts[:, line[block]] + (ends[:, line[block]] - starts[:, line[block]]) * share[block])
        for block in blocks
    ]
    costs = np.concatenate(values).reshape(nodes.shape)
    return np.where(np.isfinite(costs), costs, np.nan)


def _isolated(values: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return each row's largest change ``(L,)`` where the cost is flat on both sides of it, compared with the change; else 0.

    ``values (L, P + 1)`` are costs at the points of short lines, ``steps (L, P)`` their changes.
    """
    row, part = np.arange(len(steps)), steps.argmax(axis=1)
    rest = steps.copy()
    rest[row, part] = 0.0
    sides = np.maximum(np.abs(values[row, part] - values[:, 0]), np.abs(values[:, -1] - values[row, part + 1]))
    # beside a jump the cost changes by at most a tenth of it; beside a root or in chaos all changes are of one size
    allowed = 0.1 * steps[row, part]
    return np.where((rest.max(axis=1) <= allowed) & (np.nan_to_num(sides) <= allowed), steps[row, part], 0.0)
