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
"""Limit of integration on either side, in standard deviations: beyond it, the normal density is below 1e-17."""
SHIFTS = {1: ((0.0, 0.5, 0.25, 0.75),), 2: ((0.0, 0.5, 0.25, 0.75), (0.0, 0.25, 0.75, 0.5))}
"""Shift of each rule's panels, as a share of a panel, by number of noise dimensions: no two rules share their points."""
FIRST = {1: 512, 2: 12}
"""Panels per dimension of the coarsest rules, by number of noise dimensions."""
LEAST = {1: 1 << 15, 2: 1 << 17}
"""Fewest points, by number of noise dimensions. One: 1800 per standard deviation, enough for an event of width .001.
Two: 20 per standard deviation in each dimension."""
SAFETY = 2.0
"""Stated error, as a multiple of the largest distance of a rule from the mean of all rules."""
SETTLED = 1e-10
"""Relative error at which refinement stops."""
SOLVED = 1e-11
"""Relative error of costs of programs whose steps solve an equation to 1e-12."""
PROBES, STEP = 32, 1e-7
"""Number of stencils that measure the cost's rounding noise, and the spacing of their points in standard deviations."""


@dataclass(frozen=True)
class Integral:
    """A smoothed gradient ``(d,)``, the norm of its error, and the points used: their number and average spacing."""

    gradient: np.ndarray
    error: float
    points: int
    spacing: float


def integrate(problem: Problem, theta: np.ndarray, points: int, columns: int) -> Integral | None:
    """Return the smoothed gradient E[(f(w) - f(0)) w] / sigma for one- or two-dimensional noise on theta, by quadrature.

    Gauss-Legendre panels lie between the scene's breakpoints and are halved until the error is negligible or the next
    level would exceed ``points`` points. Every level averages four rules, shifted against each other. The stated error
    is twice the largest distance of a rule from the mean, or the change of the mean under the last halving if that is
    larger, plus rounding: the cost's measured noise, and 1e-11 of its size where steps solve equations. Returns None
    where two levels, the last of at least :data:`LEAST` points, do not fit, or a cost is not finite. A feature of the
    cost that is narrower than the spacing and not among the breakpoints is missed. The cost is evaluated ``columns``
    points at a time.
    """
    width, dim = problem.program.n_noise, problem.dim
    breaks = problem.program.breakpoints()
    edges = []
    for i in range(width):
        inner = [(b - theta[i]) / problem.sigma for b in (breaks[i] if i < len(breaks) else ())]
        edges.append(np.unique([-REACH, *(b for b in inner if abs(b) < REACH), REACH]))
    # E[w] = 0, so subtracting f(0) does not change the integral, and loses fewer digits
    centre = problem.value(theta, np.zeros((width, 1)))[0]

    def cost(nodes: np.ndarray) -> np.ndarray:
        return in_columns(lambda w: problem.value(theta, w), nodes, columns)

    rounding = _noise(cost, width) * math.sqrt(width) / problem.sigma
    panels, previous, error, used, size = FIRST[width], None, math.inf, 0, 0.0
    while True:
        rules = [[_panels(e, panels, shift) for shift in SHIFTS[width][i]] for i, e in enumerate(edges)]
        count = sum(math.prod(rule[0].size for rule in axes) for axes in zip(*rules, strict=True))
        if count > points:
            break
        gradients = []
        for axes in zip(*rules, strict=True):
            nodes = np.stack([axis.ravel() for axis in np.meshgrid(*(r[0] for r in axes), indexing="ij")])
            weights = np.ones(1)
            for _, weight in axes:
                weights = np.outer(weights, weight).ravel()
            f = cost(nodes)
            if not np.isfinite(f).all():
                return None
            gradients.append(nodes[:dim] @ (weights * (f - centre)) / problem.sigma)
            size = max(size, float(np.linalg.norm(np.abs(nodes[:dim]) @ (weights * np.abs(f))) / problem.sigma))
        mean = np.mean(gradients, axis=0)
        spread = max(float(np.linalg.norm(g - mean)) for g in gradients)
        change = math.inf if previous is None else float(np.linalg.norm(mean - previous))
        previous, error, used = mean, max(SAFETY * spread, change), count
        if count >= LEAST[width] and error <= SETTLED * np.linalg.norm(mean) + rounding:
            break
        panels *= 2
    if previous is None or used < LEAST[width] or not math.isfinite(error + rounding):
        return None
    error += rounding + (SOLVED if problem.program.needs_root else 4.0 * np.finfo(float).eps) * size
    return Integral(previous, error, used, 2.0 * REACH / used ** (1.0 / width))


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
