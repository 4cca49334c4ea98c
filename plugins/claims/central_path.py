"""C5: the central path of contact is smoothing by noise, and the price is variance."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.special import ndtr

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import estimator, function, moments, problem
from bench.model import Array

KAPPA, RADIUS = 0.25, 0.1
"""Central-path parameter of the contact [N m], and the radius of the ball [m]."""


def kink(xp: Any, x: Array) -> Array:
    """f = max(0, x): the gap of one contact after its force."""
    return xp.where(x[0] > 0, x[0], 0.0 * x[0])


KINK = function(kink, [0.0], 0.1)


class CentralPath(Claim):
    """Relaxed complementarity and randomized smoothing."""

    name = "C5"
    lesson = "The price of smoothing"
    statement = "Relaxing complementarity by kappa equals smoothing by Student t noise of two degrees of freedom."
    source = "Suh, Pang, Tedrake 2022; Pang et al. 2023"
    learned = "Relaxed contact is contact smoothed by noise of heavy tails. Only the relaxed one has no variance."
    revision = 2
    quantity = "derivative of the gap after it"

    def measure(self) -> Outcome:
        """Compare the relaxed derivative with the chance under that noise, and the kink's variances."""
        a = np.linspace(-8, 8, 801)
        # a ball at rest over one step: kappa dt^2 / m is the c of the formulas, here 1/4, so that gaps are in units of a half
        at_rest = problem(
            f"bounce_once[horizon=1,dt=1.0,radius={RADIUS}]",
            f"complementarity[kappa={KAPPA!r},stiffness=inf]",
            backend="implicit",
        )
        heights = RADIUS + np.sqrt(KAPPA) * a
        relaxed = at_rest.grad(np.stack([heights, 0 * a, 0 * a]), np.zeros((3, a.size)))[0]
        # the chance that w > -a for the density 2 / (w^2 + 4)^1.5, by integrating it, not from its formula
        chance = np.array([quad(lambda w: 2 / (w * w + 4) ** 1.5, -x, np.inf, epsabs=1e-13)[0] for x in a])
        closest = minimize_scalar(lambda s: np.abs(relaxed - ndtr(a / s)).max(), bounds=(1, 3), method="bounded")
        at = problem(KINK)
        _, (first, first_error) = moments(at, estimator("fobg"))
        _, (zeroth, zeroth_error) = moments(at, estimator("reinforce[baseline=center]"))
        figures = [
            Figure(
                "largest difference of derivative and chance", "0.0", float(np.abs(relaxed - chance).max()), spread=1e-8
            ),
            Figure("sigma of the closest Gaussian, in sqrt(c)", "1.990", float(closest.x), 1e-3),
            Figure("its largest difference", "0.0313", float(closest.fun), 1e-5),
            Figure("first-order sd at the kink, 500 samples", "0.02236", (first / 500) ** 0.5, first_error / 20),
            Figure("zeroth-order sd at the kink, 500 samples", "0.0500", (zeroth / 500) ** 0.5, zeroth_error / 20),
        ]
        curves = {
            "relaxed": relaxed,
            "smoothed by t(2) noise": chance,
            "smoothed by the closest Gaussian": ndtr(a / closest.x),
        }
        series = {"gap without force / sqrt(c)": a} | curves
        return Outcome(figures, series={name: values[::8] for name, values in series.items()})
