"""C21: on a chaotic map, the logarithm of the gradient grows by the Lyapunov exponent in each step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from bench.claims.claim import Claim, Figure, Outcome
from bench.claims.toolkit import centre, estimator, problem, terms
from bench.model import Array, FunctionScene, param

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STEPS = (1, 2, 4, 8, 16, 24)
SAMPLES = 40_000


@dataclass(frozen=True)
class Logistic(FunctionScene):
    """x is mapped to 4 x (1 - x) in each step, from x = sin^2 theta, and f is the last value: sin^2(2^T theta)."""

    name = "logistic"
    continuous: ClassVar[bool] = True
    steps: int = param(10, "iterations", positive=True)

    def theta0(self) -> np.ndarray:
        """Return an angle inside the interval."""
        return np.array([0.7])

    def cost(self, xp: Any, x: Array) -> Array:
        """Return the last iterate."""
        value = xp.sin(x[0]) ** 2
        for _ in range(self.steps):
            value = 4.0 * value * (1.0 - value)
        return value


class Lyapunov(Claim):
    """The logistic map at 4."""

    name = "C21"
    lesson = "Chaos"
    statement = (
        "The logarithm of the gradient of a chaotic map grows by its Lyapunov exponent, ln 2 = .693, in each step."
    )
    source = "Metz et al. 2021, arXiv 2111.05803"
    learned = (
        "The exponent decides after how many steps a gradient is useless, whatever the accuracy of its arithmetic."
    )
    labels = ("steps T", "mean of ln |gradient|")

    def measure(self) -> Outcome:
        """Average the logarithm of single gradients over starts, and take its slope over the steps."""
        draw, means = np.random.default_rng(21), {}
        for steps in STEPS:
            at = problem(Logistic(sigma=0.5, steps=steps))
            sizes = np.abs(terms(at, estimator("fobg"), draw.standard_normal((1, SAMPLES)))[:, 0])
            means[steps] = centre(np.log(np.maximum(sizes, 1e-300)))
        low, high = STEPS[2], STEPS[-1]
        slope = (means[high][0] - means[low][0]) / (high - low)
        error = float(np.hypot(means[high][1], means[low][1])) / (high - low)
        # f = sin^2(2^T theta), whose gradient is 2^T sin(2^(T+1) theta), and the mean of ln |sin| is -ln 2
        level = means[low][0] - low * slope
        return Outcome(
            [
                Figure("growth of ln |gradient| per step", "0.693", slope, error),
                Figure("its level, the mean of ln |sin|", "-0.693", level, means[low][1] + low * error),
            ],
            series={"steps": list(means), "means": [mean for mean, _ in means.values()]},
        )

    def draw(self, axes: Axes, series: Mapping[str, Any]) -> None:
        """Draw the growth, and the line of slope ln 2."""
        steps = np.array(series["steps"])
        axes.plot(steps, series["means"], "o", label="mean of ln |gradient|")
        axes.plot(steps, (steps - 1) * np.log(2.0), label="slope ln 2")
