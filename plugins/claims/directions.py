"""C7: how many random directions a linear function needs."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import centre, estimator, problem

D, REPEATS = 20, {20: 16_000, 100: 16_000, 400: 4000}
"""Number of variables, and of estimates per number of samples."""
NAMES = {"Gaussian: (n + 1)/N": "randomized_smoothing", "sphere: (n - 1)/N": "sphere_smoothing"}
"""Estimators by their curve."""
CHUNK = 2000
"""Number of estimates per batch."""


class Directions(Claim):
    """Gaussian directions, directions on a sphere, and differences along the axes."""

    name = "C7"
    lesson = "Which variance is smaller"
    statement = (
        "On a linear function of n variables the relative squared error of N random directions is (n + 1)/N if Gaussian, "
        "(n - 1)/N on a sphere, whatever sigma; differences along the axes have none."
    )
    source = "Nesterov, Spokoiny 2017; Berahas et al. 2022"
    learned = "Zeroth order pays for dimension: it needs as many samples as variables to be 100% off."
    quantity = "relative squared error"
    logarithmic = "xy"
    marks = (("y", 1.0, "100% off"),)
    quick = False

    def measure(self) -> Outcome:
        """Sample estimates at two noise levels."""
        figures: list[Figure] = []
        series: dict[str, list[Any]] = {f"samples N, of {D} variables": list(REPEATS), **{key: [] for key in NAMES}}
        draw = np.random.default_rng(7)
        for count, texts in ((20, ("1.05", "0.95")), (100, ("0.21", "0.19")), (400, ("0.0525", "0.0475"))):
            noise = [draw.standard_normal((CHUNK, count, D)) for _ in range(REPEATS[count] // CHUNK)]
            for sigma in (0.1, 3.0) if count == 20 else (0.1,):
                at = problem(f"linear[dimension={D},sigma={sigma}]", backend="numpy")
                for (key, name), text in zip(NAMES.items(), texts, strict=True):
                    error = _error(at, estimator(name), noise)
                    figures.append(Figure(f"{name}, N = {count}, sigma = {sigma:g}", text, *error))
                    if sigma == 0.1:
                        series[key].append(error)
        at = problem(f"linear[dimension={D}]", backend="numpy")
        exact = _error(at, estimator("finite_difference"), [draw.standard_normal((8, 20, D))])
        figures.append(Figure("finite_difference, N = 20", "0.0", exact[0], spread=1e-15))
        return Outcome(figures, series=series)


def _error(at: Any, method: Any, noise: list[np.ndarray]) -> tuple[float, float]:
    """Return the mean squared error over the squared norm of the gradient, with its standard error."""
    truth = at.program.closed_form_gradient()
    values = np.concatenate([method.estimate(at, at.program.theta0, part) for part in noise])
    return centre(((values - truth) ** 2).sum(axis=1) / (truth**2).sum())
