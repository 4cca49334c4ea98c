"""C6: variances of the three ways to differentiate an expectation."""

from __future__ import annotations

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import estimator, function, moments, problem, spread, terms
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
    learned = "On a wave the pathwise gradient pays for roughness. The score pays for dimension: no estimator is best."
    quantity = "variance of one sample"
    logarithmic = "xy"

    def measure(self) -> Outcome:
        """Integrate exactly on polynomials, by a fine rule on waves, and sample in more dimensions."""
        figures = []
        methods = {
            "pathwise": estimator("fobg"),
            "score": estimator("reinforce[baseline=none]"),
            "measure-valued": estimator("measure_valued"),
        }
        nodes, weights = np.polynomial.hermite_e.hermegauss(40)
        nodes, weights = nodes[None], weights / weights.sum()
        for k, *expected, best_text in (
            (-3.0, "4.000", "495.000", "17.49", "134.0"),
            (1.0, "4.000", "15.000", "0.000", "6.00"),
        ):
            at = problem(shifted(k))
            for (name, method), text in zip(methods.items(), expected, strict=True):
                if name == "measure-valued":
                    # its Rayleigh variable is not a polynomial of the noise
                    _, (variance, error) = moments(at, method)
                else:
                    variance, error = _variance(terms(at, method, nodes)[:, 0], weights), 1e-9
                figures.append(Figure(f"{name}, k = {k:g}", text, variance, error))
            cost, score = at.value(np.ones(1), nodes), nodes[0]
            best = (cost * score**2) @ weights / (score**2 @ weights)
            what = f"score with the best constant baseline, k = {k:g}"
            figures.append(Figure(what, best_text, _variance((cost - best) * score, weights), 1e-9))
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
            # at theta = 1 with k = 0 the score has 30 + 22 (D - 1) + 4 (D - 1)^2
            exact = f"{30 + 22 * (d - 1) + 4 * (d - 1) ** 2}.000"
            for name, text, theta in (("pathwise", "4.0", np.zeros(d)), ("score", exact, np.ones(d))):
                values = spread(terms(at, methods[name], w, theta)[:, :1])
                figures.append(Figure(f"sum of {d} squares, {name}, per coordinate", text, *values))
        curves = zip(methods, zip(*waves.values(), strict=True), strict=True)
        return Outcome(figures, series={"frequency k of cos(k x)": list(waves), **dict(curves)})


def _variance(values: np.ndarray, weights: np.ndarray) -> float:
    return float(values**2 @ weights - (values @ weights) ** 2)
