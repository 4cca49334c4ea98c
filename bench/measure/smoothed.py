"""References for smoothed costs other than J_sigma: a Gaussian of another width, or the average over a ball."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from bench.measure.batches import N_COLUMNS
from bench.measure.reference import BATCHES, LEAST_SAMPLES, Reference, doubling_batches, draw_columns
from bench.model import Problem, Program, compose
from bench.model.blocks import OfColumns


def widened(program: Program, radius: float) -> Program:
    """Return the program with sigma = ``radius``, whose J_sigma is the cost smoothed by a Gaussian of that width."""
    scene = dataclasses.replace(program.scene, sigma=radius)
    return compose(scene, program.contact, program.integrator, program.decision)


def over_ball(problem: Problem, provides: frozenset[str], radius: float, samples: int, tolerance: float) -> Reference:
    """Return the reference gradient at theta0 of the cost averaged over a ball of radius ``radius`` around theta.

    The gradient equals d / r times the mean of f u over the sphere (the divergence theorem; Flaxman et al. 2005, lemma
    2.1). With one variable it is a difference of two costs. Otherwise it is sampled, by first order inside the ball
    where the cost is continuous, or by central differences across the sphere: whichever has the lower variance in a
    pilot.
    """
    program, theta, d = problem.program, problem.program.theta0, problem.dim
    name = f"ball[radius={radius:g}]"
    if d == 1 and not program.exogenous:
        still = np.zeros((program.n_noise, 2))
        low, high = problem.value(theta[:, None] + np.array([[-radius, radius]]), still)
        return Reference(np.array([[(high - low) / (2 * radius)]]), f"{name},exact")

    def zeroth(w: np.ndarray) -> np.ndarray:
        u, _ = _polar(problem, w)
        still = problem.centred(w)
        change = problem.displaced(radius * u, theta, still) - problem.displaced(-radius * u, theta, still)
        return d * change * u / (2 * radius)

    def first(w: np.ndarray) -> np.ndarray:
        u, share = _polar(problem, w)
        return problem.grad(theta[:, None] + radius * share * u, problem.centred(w))

    orders: dict[str, OfColumns] = {"zeroth_order": zeroth}
    if program.continuous and "grad" in provides and not program.surrogate:
        orders["first_order"] = first
    columns = min(N_COLUMNS, BATCHES * max(1, samples // (4 * BATCHES)))
    pilot = draw_columns(problem, "ball pilot", columns, 0)
    spread = {order: float(terms(pilot).var(axis=1).sum()) for order, terms in orders.items()}
    chosen = min(spread, key=lambda order: spread[order] if math.isfinite(spread[order]) else math.inf)
    for batches, count, error, is_last in doubling_batches(problem, orders[chosen], "ball", columns, samples):
        if is_last or (error <= tolerance * np.linalg.norm(batches.mean(axis=0)) and count >= LEAST_SAMPLES):
            break
    return Reference(batches, f"{name},sampling[{chosen},n={count}]", samples=count)


def _polar(problem: Problem, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions ``(d, B)`` and radii ``(B,)`` in [0, 1] whose product is uniform in the unit ball."""
    from scipy.special import gammainc

    normal = problem.directions(w)
    size = np.linalg.norm(normal, axis=0)
    # the squared length is chi-squared and independent of the direction, so its distribution function is uniform
    return normal / size, gammainc(problem.dim / 2, size**2 / 2) ** (1 / problem.dim)
