"""C19: a chaotic map: the first order's variance grows by 4 each step, the zeroth order's stays."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import estimator, function, problem, spread, terms
from bench.model import Array, FunctionScene

SAMPLES = 400_000
WEIGHED, MIXED = 2, 40_000
"""Steps at which the variance of the estimator ``inverse_variance`` is measured, and the number of its estimates."""


def tent(steps: int) -> FunctionScene:
    """Return the last value of x after steps that map it to 1 - |1 - 2 x|."""

    def cost(xp: Any, x: Array) -> Array:
        value = x[0]
        for _ in range(steps):
            value = 1.0 - xp.abs(1.0 - 2.0 * value)
        return value

    return function(cost, [0.3], 0.05)


class Chaos(Claim):
    """The tent map."""

    name = "C19"
    lesson = "Chaos"
    statement = (
        "Through T steps of a chaotic map the first order's variance grows as 4^T while the zeroth order's stays, so that "
        "the best mixture is 1.6e10 times better at T = 20."
    )
    source = "Metz et al. 2021; Parmas et al. 2018; figures for the tent map in closed form"
    origin = "recomputed"
    learned = "Beyond the horizon of chaos derivatives are right and useless; sampling does not care."
    quantity = "variance of one sample"
    logarithmic = "y"

    def measure(self) -> Outcome:
        """Sample both orders at several horizons."""
        first, zeroth = estimator("fobg"), estimator("reinforce[baseline=center]")
        draw = np.random.default_rng(19)
        figures, horizons, variances = [], [1, 2, 5, 10, 14, 20], []
        for steps in horizons:
            at = problem(tent(steps))
            # at T = 20 the source states the gain with two digits
            w = draw.standard_normal((1, 8 * SAMPLES if steps == 20 else SAMPLES))
            gradients = terms(at, first, w)
            (v1, e1), (v0, e0) = spread(gradients), spread(terms(at, zeroth, w))
            variances.append([(v1, e1), (v0, e0)])
            if text := {10: "1.05e6", 20: "1.10e12"}.get(steps):
                figures += [
                    Figure(f"first-order variance, T = {steps}", text, v1, e1),
                    Figure(f"zeroth-order variance, T = {steps}", "70", v0, e0),
                    Figure(f"size of every gradient, T = {steps}", f"{2.0**steps:.1f}", float(np.abs(gradients).max())),
                ]
        # weights in inverse proportion to the variances, whose covariance is far below both
        for what, text, mixed, slack in (
            ("gain of the best mixture, T = 20", "1.6e10", v1 * v0 / (v1 + v0), 0.0),
            # half of 1.6e10, whose last digit leaves 5e8 open
            ("the same with the samples split", "8.0e9", 2 * v1 * 2 * v0 / (2 * v1 + 2 * v0), 2e8),
        ):
            figures.append(Figure(what, text, v1 / mixed, v1 / mixed * (e0 / v0), slack))
        # the same by the estimator that splits them, on fewer steps, where its weights are not too far from one half
        at, mixture = problem(tent(WEIGHED)), estimator("inverse_variance")
        v1, e1 = spread(terms(at, first, draw.standard_normal((1, SAMPLES))))
        w = draw.standard_normal((1, SAMPLES))
        cost = at.value(at.program.theta0, w)
        # the estimator's baseline is the mean cost of the other samples
        v0, e0 = spread(((cost - cost.mean()) * at.score(at.program.theta0, w)).T)
        ratio = v1 / (v0 + v1)
        expected = 2.0 * v0 * ratio
        noises = (draw.standard_normal((MIXED // 8, 1000, 1)) for _ in range(8))
        each = np.concatenate([mixture.estimate(at, at.program.theta0, noise) for noise in noises])
        measured, error = spread(1000**0.5 * each)
        error = float(np.hypot(error, expected * (e0 / v0 + (1.0 - ratio) * e1 / v1)))
        what = f"variance of inverse_variance, T = {WEIGHED}, over that of the best mixture"
        figures.append(Figure(what, "1.000", measured / expected, error / expected))
        growing, staying = zip(*variances, strict=True)
        return Outcome(figures, series={"steps T": horizons, "first order: 4^T": growing, "zeroth order": staying})
