"""C4: a pivot that falls off an edge. Descent on first-order gradients crosses the edge."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import centre, estimator, function, means, moments, problem, stochastic_descent
from bench.model import Array

SIGMA = 0.02


def pivot(xp: Any, x: Array) -> Array:
    """f = -sin^2 x up to |x| = pi/4 and 0 beyond: further is better, until the pivot falls."""
    value = -(xp.sin(x[0]) ** 2)
    return xp.where(xp.abs(x[0]) <= math.pi / 4, value, 0.0 * value)


SCENE = function(pivot, [0.1], SIGMA, continuous=False)


class FallingPivot(Claim):
    """The edge of a reward."""

    name = "C4"
    lesson = "Low variance is not low bias"
    statement = "A first-order descent towards the best angle of a pivot walks over its edge; a zeroth-order one stops in front."
    source = "Suh et al. 2022, ICML"
    learned = "Near the edge the first-order gradient misses exactly the part that warns: the jump times its density."
    quantity = "mean gradient"
    marks = (("x", math.pi / 4, "edge"),)

    def measure(self) -> Outcome:
        """Integrate the missing part, and descend."""
        at, orders = problem(SCENE), (estimator("fobg"), estimator("reinforce[baseline=none]"))
        figures = []
        for text, x, label in (("-0.7586", 0.74, "0.74"), ("-4.453", 0.76, "0.76"), ("-9.974", math.pi / 4, "pi/4")):
            (first, error), (truth, truth_error) = (moments(at, order, x, 200_000)[0] for order in orders)
            figures.append(
                Figure(f"first-order mean less the gradient at {label}", text, first - truth, error + truth_error)
            )
        fallen = stochastic_descent(at, False, 0.01, 500, seed=4)
        stopped = stochastic_descent(at, True, 0.01, 500, seed=44)
        figures += [
            Figure("end of the first-order descent", "0.843", *centre(fallen), spread=0.002),
            Figure("cost there", "0.0", float(at.value(fallen[None], np.zeros((1, fallen.size))).max())),
            Figure("end of the zeroth-order descent", "0.74", *centre(stopped), spread=0.02),
        ]
        grid = np.linspace(0.6, 0.9, 61)
        low, true = (means(at, order, grid, 20_000) for order in orders)
        return Outcome(figures, series={"angle [rad]": grid, "true": true, "first-order mean": low})
