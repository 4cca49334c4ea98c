"""C1: at a jump the first-order gradient is exactly wrong, without any variance."""

from __future__ import annotations

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import estimator, moments, problem


class Step(Claim):
    """The unit step under Gaussian noise of 0.1."""

    name = "C1"
    lesson = "Low variance is not low bias"
    statement = (
        "On a unit step the first-order gradient is 0 with variance 0, although the smoothed cost has a slope of 3.99."
    )
    source = "Suh et al. 2022, ICML"
    learned = "A gradient that repeats itself perfectly can be wholly wrong."
    labels = ("theta", "mean gradient")
    curves = {
        "zeroth": "zeroth order: the slope",
        "first": "first order: 0 everywhere",
    }

    def measure(self) -> Outcome:
        """Integrate both estimators over the noise."""
        first, zeroth = estimator("fobg"), estimator("reinforce")
        at = problem("heaviside[sigma=0.1]")
        (mean, mean_error), (variance, _) = moments(at, first)
        (slope, slope_error), (centred, centred_error) = moments(at, zeroth)
        _, (moved, moved_error) = moments(at, zeroth, 0.1)
        _, (bare, bare_error) = moments(at, estimator("reinforce[baseline=none]"), 0.1)
        figures = [
            Figure("slope of the smoothed cost at 0", "3.98942", slope, slope_error),
            Figure("first-order mean", "0.0", mean, mean_error),
            Figure("first-order variance", "0.0", variance),
            Figure("zeroth-order variance at 0", "34.085", centred, centred_error),
            Figure("zeroth-order variance at 0.1", "34.208", moved, moved_error),
            Figure("zeroth-order variance at 0.1 without a baseline", "54.08", bare, bare_error),
        ]
        thetas = np.linspace(-0.3, 0.3, 25)
        curves = {
            name: [moments(at, order, x, 4000)[0][0] for x in thetas]
            for name, order in (("first", first), ("zeroth", zeroth))
        }
        return Outcome(figures, series={"theta": thetas} | curves)
