"""Certified gradients: closed form, then quadrature, then long sampling with its own standard error."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from bench.measure import noise
from bench.measure.statistics import Truth
from bench.model import Problem

BATCHES = 64
"""Number of independent batch means that a sampled reference is stored as."""
COLUMNS = 4096
"""Columns of every batch evaluated, so that a compiling backend compiles once; fewer where few samples are allowed.

One batch is also the budget for choosing the estimator of a sampled reference.
"""
QUADRATURE_POINTS = 1 << 20
QUADRATURE_TOLERANCE = 1e-3
"""Relative error above which quadrature gives way to sampling."""


@dataclass(frozen=True)
class Reference:
    """A certified grad J_sigma.

    ``batches (K, d)`` are independent estimates whose mean is the gradient, or one row where it has no sampling
    error. ``error`` bounds the norm of the error left by a deterministic method. ``plain (d,)`` is the program's
    gradient at w = 0 and ``physical (d,)`` that of the physics it approximates; each is empty when unknown.
    """

    batches: np.ndarray
    method: str
    error: float = 0.0
    plain: np.ndarray = field(default_factory=lambda: np.empty(0))
    physical: np.ndarray = field(default_factory=lambda: np.empty(0))

    @property
    def gradient(self) -> np.ndarray:
        """grad J_sigma, ``(d,)``."""
        return self.batches.mean(axis=0)

    def known(self) -> Truth:
        """Return the reference as the statistics take it: a mean and its sampling error."""
        if len(self.batches) > 1:
            return Truth.from_batches(self.batches)
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
) -> Reference:
    """Compute the reference of a problem by the best method that applies.

    Sampling stops at a standard error of ``tolerance`` times the gradient's norm, or after ``samples`` samples.
    ``physical (d,)`` is the gradient that the program approximates, if known. A closed form belongs to the scene's own
    program, so it is not used for a backend that ``provides`` physics of its own.
    """
    program = problem.program
    theta = program.theta0
    if program.surrogate:
        # its gradient is not the derivative of the program, so that only costs can certify one
        provides = provides - {"grad"}
    closed = None if "physics" in provides else program.closed_form_gradient()
    if closed is not None:
        found = Reference(np.asarray(closed, dtype=np.float64).reshape(1, -1), "closed_form")
    else:
        quadrature = None
        if program.n_noise <= 2 and program.noise_on_theta:
            quadrature = _quadrature(problem, theta, min(QUADRATURE_POINTS, 64 * samples))
        found = quadrature or _sampled(problem, theta, provides, samples, tolerance)
    if physical is None or "grad" not in provides:
        return found
    plain = problem.grad(theta, np.zeros((program.n_noise, 1)))[:, 0]
    return Reference(found.batches, found.method, found.error, plain, np.asarray(physical, dtype=np.float64))


# ---------------------------------------------------------------------------------------------- quadrature


def _quadrature(problem: Problem, theta: np.ndarray, points: int) -> Reference | None:
    """Integrate E[(f(w) - f(0)) w] / sigma on Gauss-Legendre panels between breakpoints, refined until it settles.

    The error is the change under the last halving of the panels. Returns None when the error stays above 0.1%.
    """
    width, dim = problem.program.n_noise, problem.dim
    breaks = problem.program.breakpoints()
    edges = []
    for i in range(width):
        inner = [(b - theta[i]) / problem.sigma for b in (breaks[i] if i < len(breaks) else ())]
        # beyond 9 standard deviations the normal density is below 1e-17
        edges.append(np.unique([-9.0, *(b for b in inner if abs(b) < 9.0), 9.0]))
    # E[w] = 0, so subtracting f at w = 0 keeps the integral and loses fewer digits
    centre = problem.value(theta, np.zeros((width, 1)))[0]
    panels, previous, error = 16, None, math.inf
    while (panels * 8) ** width <= points:
        rules = [_panels(e, panels) for e in edges]
        nodes = np.stack([axis.ravel() for axis in np.meshgrid(*(r[0] for r in rules), indexing="ij")])
        weights = np.ones(1)
        for _, weight in rules:
            weights = np.outer(weights, weight).ravel()
        f = problem.value(theta, nodes) - centre
        gradient = nodes[:dim] @ (weights * f) / problem.sigma
        if not np.isfinite(gradient).all():
            return None
        if previous is not None:
            error = float(np.linalg.norm(gradient - previous))
            if error <= 1e-10 * np.linalg.norm(gradient):
                break
        previous, panels = gradient, panels * 2
    if previous is None or error > QUADRATURE_TOLERANCE * np.linalg.norm(gradient):
        return None
    return Reference(gradient[None, :], f"quadrature[points={nodes.shape[1]}]", error)


def _panels(edges: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights (normal density included) of ``count`` 8-point Gauss-Legendre panels or a few more."""
    x, w = np.polynomial.legendre.leggauss(8)
    spans = np.diff(edges)
    shares = np.maximum(1, np.round(count * spans / spans.sum()).astype(int))
    cuts = np.unique(
        np.concatenate([np.linspace(a, b, n + 1) for a, b, n in zip(edges, edges[1:], shares, strict=False)])
    )
    half = np.diff(cuts)[:, None] / 2
    nodes = ((cuts[:-1, None] + half) + half * x).ravel()
    return nodes, (half * w).ravel() * np.exp(-(nodes**2) / 2) / math.sqrt(2 * math.pi)


# ------------------------------------------------------------------------------------------------ sampling


def _sampled(
    problem: Problem, theta: np.ndarray, provides: frozenset[str], samples: int, tolerance: float
) -> Reference:
    """Sample with the valid estimator of lowest variance, in independent batches, cross-checked by zeroth order."""
    columns = min(COLUMNS, BATCHES * max(1, samples // (4 * BATCHES)))
    centre = problem.value(theta, np.zeros((problem.program.n_noise, 1)))
    estimators: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "zeroth_order": lambda w: _antithetic(problem, theta, w, centre)
    }
    if problem.program.continuous and "grad" in provides:
        estimators["first_order"] = lambda w: problem.grad(theta, w)
    pilots = {name: terms(_draw(problem, "pilot", columns, 0)) for name, terms in estimators.items()}
    spread = {name: float(p.var(axis=1, ddof=1).sum()) for name, p in pilots.items() if np.isfinite(p).all()}
    if not spread:
        return Reference(np.full((1, problem.dim), math.nan), "sampling[failed: rollouts are not finite]", math.nan)
    chosen = min(spread, key=lambda name: spread[name])
    # first order misses something, such as a jump that the scene does not declare
    if chosen == "first_order" and _disagree(pilots["first_order"], pilots["zeroth_order"]) > 5.0:
        chosen = "zeroth_order"

    size = columns // BATCHES
    batches = np.zeros((BATCHES, problem.dim))
    count = 0
    while True:
        w = _draw(problem, "reference", BATCHES * size, count)
        terms = _in_columns(estimators[chosen], w, columns).reshape(problem.dim, BATCHES, size).mean(axis=2).T
        batches = (batches * count + terms * size) / (count + size)
        count += size
        se = math.sqrt(batches.var(axis=0, ddof=1).sum() / BATCHES)
        # each pass doubles the samples, so stop if the next one would exceed the budget
        if se <= tolerance * np.linalg.norm(batches.mean(axis=0)) or 2 * count * BATCHES > samples:
            break
        size = count
    note = ""
    if chosen == "first_order":
        w = _draw(problem, "check", max(columns, count * BATCHES // 4 // columns * columns), 0)
        check = _in_columns(estimators["zeroth_order"], w, columns)
        z = _disagree(batches.T, check)
        note = f",check_z={z:.1f}"
    return Reference(batches, f"sampling[{chosen},n={count * BATCHES}{note}]")


def _draw(problem: Problem, stream: str, count: int, block: int) -> np.ndarray:
    """Draw noise ``(n_w, count)`` from the reference's own streams, which no cell uses."""
    program = problem.program
    drawn = noise.draw(block, program.scene.name, 1, count, program.n_noise, stream)
    return np.moveaxis(drawn, -1, 0).reshape(program.n_noise, count)


def _in_columns(terms: Callable[[np.ndarray], np.ndarray], w: np.ndarray, columns: int) -> np.ndarray:
    return np.concatenate([terms(w[:, i : i + columns]) for i in range(0, w.shape[1], columns)], axis=1)


def _antithetic(problem: Problem, theta: np.ndarray, w: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return zeroth-order terms averaged over w and -w, with the cost at w = 0 as baseline, ``(d, B)``."""
    terms = ((problem.value(theta, s) - centre) * problem.score(theta, s) + problem.explicit(theta, s) for s in (w, -w))
    return np.asarray(sum(terms) / 2)


def _disagree(a: np.ndarray, b: np.ndarray) -> float:
    """Return the distance of two independent sample means ``(d, B)`` beyond its expectation, in standard deviations."""
    mean = a.mean(axis=1) - b.mean(axis=1)
    s = np.atleast_2d(np.cov(a)) / a.shape[1] + np.atleast_2d(np.cov(b)) / b.shape[1]
    spread = math.sqrt(2 * np.trace(s @ s))
    return float((mean @ mean - np.trace(s)) / spread) if spread > 0 else 0.0 if not mean.any() else math.inf
