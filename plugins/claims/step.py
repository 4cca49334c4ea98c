"""C1: at a jump the first-order gradient is exactly wrong, without any variance."""

from __future__ import annotations

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import estimator, means, moments, problem


class Step(Claim):
    """The unit step under Gaussian noise of 0.1."""

    name = "C1"
    lesson = "Low variance is not low bias"
    statement = (
        "On a unit step the first-order gradient is 0 with variance 0, although the smoothed cost has a slope of 3.99."
    )
    source = "Suh et al. 2022, ICML"
    learned = "A gradient that repeats itself perfectly can be wholly wrong."
    quantity = "mean gradient"

    def measure(self) -> Outcome:
        """Integrate both estimators over the noise."""
        first, zeroth = estimator("fobg"), estimator("reinforce[baseline=center]")
        at = problem("heaviside[sigma=0.1]")
        mean, variance = moments(at, first)
        slope, centred = moments(at, zeroth)
        figures = [
            Figure("slope of the smoothed cost at 0", "3.98942", *slope),
            Figure("first-order mean", "0.0", *mean),
            Figure("first-order variance", "0.0", variance[0]),
            Figure("zeroth-order variance at 0", "34.085", *centred),
            Figure("zeroth-order variance at 0.1", "34.208", *moments(at, zeroth, 0.1)[1]),
            Figure(
                "zeroth-order variance at 0.1 without a baseline",
                "54.08",
                *moments(at, estimator("reinforce[baseline=none]"), 0.1)[1],
            ),
        ]
        thetas = np.linspace(-0.3, 0.3, 25)
        return Outcome(
            figures,
            series={
                "theta": thetas,
                "zeroth order: the slope": means(at, zeroth, thetas, 4000),
                "first order: 0 everywhere": means(at, first, thetas, 4000),
            },
        )
