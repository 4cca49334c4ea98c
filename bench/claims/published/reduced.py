"""C25: variances and biases of the estimators that clip, guide, rotate, mix, correct or cut gradients."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from bench.claims.claim import Claim, Figure, Outcome
from bench.claims.toolkit import centre, estimator, plugin, problem
from bench.model import Array, DiagnosticEstimator, FunctionScene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

D = 8
"""Length of theta on the plane."""
REPEATS = 400_000


@dataclass(frozen=True)
class Parabola(FunctionScene):
    """f = x^2 / 2 at theta = 1, so that a gradient is 1 + sigma w."""

    name = "parabola"
    continuous: ClassVar[bool] = True

    def theta0(self) -> np.ndarray:
        """Return 1."""
        return np.ones(1)

    def cost(self, xp: Any, x: Array) -> Array:
        """Return half the square."""
        return 0.5 * x[0] * x[0]


class Reduced(Claim):
    """Estimators that change gradients."""

    name = "C25"
    lesson = "Low variance is not low bias"
    statement = (
        "Clipping at 1 takes the mean of N(1, 1) to .6095; the best coefficient of a linear control variate is 1 on a parabola; "
        "orthogonal directions have the error d / N - 1 on a plane, guided ones the variance 2 + 7 share; inverse variances "
        "weigh the first order by .852; truncation keeps the gradient of the last window."
    )
    source = (
        "Greene 2012, section 19.3 (censored means); Glasserman 2003, chapter 4; Choromanski et al. 2018; Maheswaranathan "
        "et al. 2019; Parmas et al. 2018; Williams, Peng 1990"
    )
    learned = "Each way to reduce variance has its price in bias, and both can be computed on a simple cost."
    labels = ("estimator", "figure")

    def measure(self) -> Outcome:
        """Compare means and variances on a parabola, a plane and a double integrator with closed forms."""
        law = plugin("contacts", "softplus[stiffness=1.0,beta=10.0]")
        touch = float(law.force(np, np.zeros((1, 1)), np.zeros((1, 1)))[0, 0])
        figures = [*self._on_the_parabola(), *self._on_the_plane(), self._truncated()]
        figures.append(Figure("softplus: ln 2 / 10 at touch, for a penalty of 0", "0.0693", touch))
        return Outcome(figures, series={figure.what: figure.measured for figure in figures})

    @staticmethod
    def _on_the_parabola() -> list[Figure]:
        at, draw = problem(Parabola(sigma=1.0), backend="numpy"), np.random.default_rng(24)
        theta = at.program.theta0
        cut = estimator("clipped[limit=1.0]").estimate(at, theta, draw.standard_normal((REPEATS, 1, 1)))[:, 0]
        linear, mixing = estimator("control_variate"), estimator("total_propagation")
        assert isinstance(linear, DiagnosticEstimator)
        corrected, fitted = linear.estimate_with_diagnostics(at, theta, draw.standard_normal((4000, 400, 1)))
        assert isinstance(mixing, DiagnosticEstimator)
        # one confidence interval of the zeroth order is wide enough for its weights
        mixed = estimator("alpha_order").estimate(at, theta, draw.standard_normal((400, 4000, 1)))
        differences = estimator("finite_difference").estimate(at, theta, draw.standard_normal((400, 400, 1)))
        values, decided = mixing.estimate_with_diagnostics(at, theta, draw.standard_normal((400, 4000, 1)))
        return [
            Figure("clipped: mean of N(1, 1) within 1", "0.6095", *centre(cut)),
            Figure("control_variate: coefficient", "1.000", *centre(fitted["coefficient"]), spread=0.005),
            Figure("control_variate: mean", "1.000", *centre(corrected[:, 0]), spread=1e-4),
            Figure("alpha_order: mean", "1.000", *centre(mixed[:, 0]), spread=0.005),
            Figure("finite_difference: slope of a parabola", "1.000", *centre(differences[:, 0]), spread=0.005),
            Figure("total_propagation: weight, 5.75 / 6.75", "0.852", *centre(decided["weight"].mean(axis=1))),
            Figure("total_propagation: mean", "1.000", *centre(values[:, 0]), spread=0.005),
        ]

    @staticmethod
    def _on_the_plane() -> list[Figure]:
        at, draw = problem(f"linear[dimension={D}]", backend="numpy"), np.random.default_rng(25)
        theta = at.program.theta0
        truth = at.grad(theta, np.zeros((D, 1)))[:, 0]
        size = float(truth @ truth)
        two = estimator("orthogonal[lengths=fixed]").estimate(at, theta, draw.standard_normal((REPEATS // 10, 2, D)))
        errors = ((two - truth) ** 2).sum(axis=1) / size
        guided = estimator("guided[subspace=1,share=0.1]").estimate(at, theta, draw.standard_normal((REPEATS, 2, D)))
        return [
            Figure("orthogonal: squared error of 2 of 8 directions", "3.00", *centre(errors)),
            Figure("guided: mean along the gradient", "1.000", *centre(guided @ truth / size)),
            Figure("guided: variance, 2 + 7 / 10", "2.70", *centre(((guided - truth) ** 2).sum(axis=1) / size)),
        ]

    @staticmethod
    def _truncated() -> Figure:
        at = problem("double_integrator[horizon=20]")
        still = np.zeros((1, 1, at.program.n_noise))
        full, window = (
            estimator(name).estimate(at, at.program.theta0, still)[0] for name in ("fobg", "windowed[steps=5]")
        )
        # the derivatives by the controls are proportional to 20, 19, ..., 1, and the last five remain
        share = float(window @ full / (full @ full))
        return Figure("windowed: (25 + 16 + 9 + 4 + 1) / 2870", "0.01916", share, spread=1e-9)

    def draw(self, axes: Axes, series: Mapping[str, Any]) -> None:
        """Draw the figures."""
        axes.barh([name.partition(":")[0] for name in series], list(series.values()))
