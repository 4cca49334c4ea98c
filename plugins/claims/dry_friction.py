"""L4: the derivative of a sticking block is 0, and with noise it is not."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import ndtr

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import estimator, function, means, moments, problem
from bench.model import Array


def dry_friction(xp: Any, x: Array) -> Array:
    """The acceleration of a block at rest, pushed with force x: x - sign(x) if |x| > 1, else 0."""
    beyond = xp.abs(x[0]) - 1.0
    return xp.sign(x[0]) * xp.where(beyond > 0, beyond, 0.0 * beyond)


SCENE = function(dry_friction, [0.0], 1.0)


class Sticking(Claim):
    """Dry friction at rest."""

    name = "L4"
    lesson = "The price of smoothing"
    statement = (
        "A sticking block's exact derivative is 0; smoothed it is Phi((F - mu)/s) + Phi((-F - mu)/s), .3173 at F = 0."
    )
    source = "Le Lidec et al. 2023"
    learned = "An exact zero can be right and still of no use to an optimiser; noise looks past the edge of the cone."
    quantity = "derivative of the acceleration"

    def measure(self) -> Outcome:
        """Compute the exact derivative, and integrate both orders over the noise."""
        at = problem(SCENE)
        forces = np.linspace(-4, 4, 41)
        exact = at.grad(forces[None], np.zeros((1, forces.size)))[0]
        smooth = means(at, estimator("fobg"), forces, 20_000)
        formula = ndtr(forces - 1) + ndtr(-forces - 1)
        figures = [
            Figure("exact derivative at rest", "0.0", float(exact[20])),
            Figure("smoothed, first order", "0.3173", *moments(at, estimator("fobg"))[0]),
            Figure("smoothed, zeroth order", "0.3173", *moments(at, estimator("reinforce[baseline=center]"))[0]),
            Figure(
                "largest difference from the formula, F from -4 to 4",
                "0.0",
                float(np.abs(smooth - formula).max()),
                spread=2e-3,
            ),
        ]
        return Outcome(figures, series={"push F": forces, "smoothed, s = mu": smooth, "exact": exact})
