"""C22: a chaotic recurrence: the pathwise gradient is far better over few steps, and without bound worse over many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from bench.claims.claim import Claim, Figure, Outcome
from bench.claims.colours import bars, estimator_colour
from bench.claims.toolkit import estimator, problem, terms
from bench.model import Array, MechanicalScene, Problem, State, param

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PUBLISHED = {
    5: ("7.0e-8", "4.0e-5"), 10: ("2.5e-3", "1.6"), 20: ("7.9e-3", "6.6"), 50: ("0.24", "19"), 100: ("37", "81"),
}  # fmt: skip
"""Variances of one sample by number of steps: pathwise, likelihood ratio."""
DRAWS, SAMPLES = 10, 10_000
HEAVY = {50: 4.0, 100: 20.0}
"""Steps at which the pathwise variance has heavy tails, and the factor by which draws differ."""


@dataclass(frozen=True)
class Recurrent(MechanicalScene):
    """s' = sigmoid(beta s W) plus noise; theta = beta, f = half the squared distance of the last s from (1, 1).

    s is the velocity, and the sigmoid the policy's action, so that the noise of the actions is that of the state. The
    positions affect nothing.
    """

    name = "recurrent"
    neglected_effects = "none: the recurrence is the model"
    continuous: ClassVar[bool] = True
    n_q: ClassVar[int] = 2
    n_u: ClassVar[int] = 2

    sigma: float = param(0.001, "standard deviation of the noise on s in each step", positive=True)
    noise: str = param("action", "noise is on the actions", choices=("action",))
    horizon: int = param(10, "number of steps", "steps", positive=True)
    dt: float = param(1.0, "length of a time step", "s", positive=True)

    def theta0(self) -> np.ndarray:
        """Return beta."""
        return np.array([2.4])

    def initial_state(self, xp: Any, theta: Array) -> State:
        """Return s = (.35, .55)."""
        zero = 0.0 * theta[0]
        return State(xp.stack([zero, zero]), xp.stack([zero + 0.35, zero + 0.55]))

    def feedback(self, xp: Any, theta: Array, q: Array, v: Array) -> Array:
        """Return sigmoid(beta s W)."""
        apart = theta[0] * (v[1] - v[0])
        return xp.stack([1.0 / (1.0 + xp.exp(-5.0 * apart)), 1.0 / (1.0 + xp.exp(-25.0 * apart))])

    def acceleration(self, xp: Any, q: Array, v: Array, u: Array) -> Array:
        """Return the change to the action within a step."""
        return (u - v) / self.dt

    def terminal_cost(self, xp: Any, q: Array, v: Array) -> Array:
        """Return half the squared distance from (1, 1)."""
        return 0.5 * ((v[0] - 1.0) ** 2 + (v[1] - 1.0) ** 2)


class RecurrentVariances(Claim):
    """Pathwise and likelihood-ratio variances through a recurrence."""

    name = "C22"
    lesson = "Chaos"
    statement = (
        "Through 5 to 100 steps of a chaotic recurrence the variance of the pathwise gradient grows from 7e-8 to about 37, "
        "that of the likelihood ratio from 4e-5 to 81."
    )
    source = "Parmas et al. 2018, ICML, and its public demonstration"
    learned = "Over few steps the pathwise gradient is far better. Over many its rare large values decide, and its variance is not known."
    labels = ("steps T", "variance of one sample")
    quick = False

    def measure(self) -> Outcome:
        """Sample both at each horizon, in ten draws."""
        figures, variances = [], {}
        for steps, published in PUBLISHED.items():
            at = problem(Recurrent(horizon=steps))
            draws = np.array([_variances(at, np.random.default_rng([22, steps, i])) for i in range(DRAWS)])
            means, errors = draws.mean(axis=0), draws.std(axis=0, ddof=1) / DRAWS**0.5
            variances[steps] = list(zip(means.tolist(), errors.tolist(), strict=True))
            for k, name in enumerate(("pathwise", "likelihood ratio")):
                what = f"{name} variance, T = {steps}"
                if k == 0 and steps in HEAVY:
                    figures.append(Figure(what, published[k], means[k], errors[k], factor=HEAVY[steps]))
                else:
                    # the published number is from one draw, whose number of samples is not stated
                    spread = 2.0 * float(draws[:, k].std(ddof=1))
                    figures.append(Figure(what, published[k], means[k], errors[k], spread=spread))
        return Outcome(
            figures,
            series={
                "steps": list(variances),
                "first": [pair[0] for pair in variances.values()],
                "zeroth": [pair[1] for pair in variances.values()],
            },
        )

    def draw(self, axes: Axes, series: Mapping[str, Any]) -> None:
        """Draw both variances against the number of steps."""
        axes.set_yscale("log")
        bars(axes, series["steps"], series["first"], fmt="o-", color=estimator_colour("fobg"), label="pathwise")
        bars(
            axes,
            series["steps"],
            series["zeroth"],
            fmt="s-",
            color=estimator_colour("reinforce"),
            label="likelihood ratio",
        )


def _variances(at: Problem, random: np.random.Generator) -> tuple[float, float]:
    """Return the variances of one sample of both gradients, the likelihood ratio's with the mean cost as baseline."""
    w = random.standard_normal((at.program.n_noise, SAMPLES))
    first = terms(at, estimator("fobg"), w)[:, 0]
    zeroth = terms(at, estimator("reinforce[baseline=none]"), w)[:, 0]
    score = at.score(at.program.theta0, w)[0]
    return float(first.var(ddof=1)), float((zeroth - at.value(at.program.theta0, w).mean() * score).var(ddof=1))
