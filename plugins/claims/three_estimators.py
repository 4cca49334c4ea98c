"""C6: variances of the three ways to differentiate an expectation."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.claims.claim import Claim, Figure, Outcome
from bench.claims.toolkit import estimator, function, hermite, moments, problem, spread, terms
from bench.model import FunctionScene


def shifted(shift: float, dimension: int = 1) -> FunctionScene:
    """Return f = sum_i (x_i - shift)^2 at theta = 1."""
    return function(lambda xp, x: xp.sum((x - shift) ** 2, axis=0), np.ones(dimension), 1.0)


def wave(frequency: float) -> FunctionScene:
    """Return f = cos(frequency x) at theta = 1."""
    return function(lambda xp, x: xp.cos(frequency * x[0]), [1.0], 1.0)


class ThreeEstimators(Claim):
    """Pathwise, score and measure-valued gradients."""

    name = "C6"
    lesson = "Which variance is smaller"
    statement = (
        "Which of pathwise, score and measure-valued gradient has the least variance depends on the cost: pathwise wins on "
        "a parabola, and loses on a fast wave by the square of its frequency."
    )
    source = "Mohamed et al. 2020, JMLR"
    learned = "No estimator is best: roughness costs the first order, dimension the score."
    labels = ("frequency k of cos(k x)", "variance of one sample")
    logarithmic = "xy"
    curves = {
        "pathwise": "pathwise",
        "score": "score",
        "measure-valued": "measure-valued",
    }

    def measure(self) -> Outcome:
        """Integrate exactly on polynomials, by a fine rule on waves, and sample in more dimensions."""
        figures = []
        nodes, weights = hermite()
        methods = {
            "pathwise": estimator("fobg"),
            "score": estimator("reinforce[baseline=none]"),
            "measure-valued": estimator("measure_valued"),
        }
        for k, expected in ((-3.0, ("4", "495", "17.49")), (1.0, ("4", "15", "0"))):
            at = problem(shifted(k))
            for (name, method), text in zip(methods.items(), expected, strict=True):
                if name == "measure-valued":
                    # its Rayleigh variable is not a polynomial of the noise
                    _, (variance, error) = moments(at, method)
                else:
                    values = terms(at, method, nodes)[:, 0]
                    variance, error = float(values**2 @ weights - (values @ weights) ** 2), 1e-9
                figures.append(Figure(f"{name}, k = {k:g}", _exact(text), variance, error))
            figures.append(self._best_baseline(at, k, nodes, weights))
        waves = {}
        for k, text in ((1, "0.826"), (2, "4.40"), (4, "16"), (8, "64")):
            at = problem(wave(float(k)))
            waves[k] = [moments(at, method, count=100_000)[1] for method in methods.values()]
            (path, path_error), (score, score_error), _ = waves[k]
            relative = path_error / path + score_error / score
            figures.append(Figure(f"cos({k} x): pathwise / score", text, path / score, relative * path / score))
        draw = np.random.default_rng(6)
        for d in (2, 8):
            at = problem(shifted(0.0, d))
            w = draw.standard_normal((d, 400_000))
            theta = np.zeros(d)
            first, error = spread(terms(at, methods["pathwise"], w, theta)[:, :1])
            figures.append(Figure(f"sum of {d} squares, pathwise, per coordinate", "4.0", first, error))
            score, error = spread(terms(at, methods["score"], w, np.ones(d))[:, :1])
            # at theta = 1 with k = 0: 30 + 22 (D - 1) + 4 (D - 1)^2
            figures.append(
                Figure(
                    f"sum of {d} squares, score, per coordinate",
                    _exact(str(30 + 22 * (d - 1) + 4 * (d - 1) ** 2)),
                    score,
                    error,
                )
            )
        return Outcome(
            figures,
            series={"k": list(waves), **{n: [v[i] for v in waves.values()] for i, n in enumerate(methods)}},
        )

    def _best_baseline(self, at: Any, k: float, nodes: np.ndarray, weights: np.ndarray) -> Figure:
        """Return the score estimator's variance with the constant baseline that minimises it."""
        cost, score = at.value(np.ones(1), nodes), nodes[0]
        best = (cost * score**2) @ weights / (score**2 @ weights)
        values = (cost - best) * score
        variance = float(values**2 @ weights - (values @ weights) ** 2)
        return Figure(
            f"score with the best constant baseline, k = {k:g}", {-3.0: "134.0", 1.0: "6.00"}[k], variance, 1e-9
        )


def _exact(text: str) -> str:
    """Return an integer of the source's formula as text with enough digits to be exact."""
    return text if "." in text else f"{text}.000"
