"""The cross-entropy method."""

from dataclasses import dataclass

import numpy as np

from bench.model import Answer, OptimizerState, Population, param


@dataclass(frozen=True)
class Cem(Population):
    """The cross-entropy method (Rubinstein 1999): repeatedly fits a diagonal normal distribution to the best points.

    On a linear cost with elite share rho and z the normal quantile of rho, the mean moves by -sigma phi(z) / rho and
    the variance is multiplied by 1 - z phi(z) / rho - (phi(z) / rho)^2. By ``spread``, the variance of the elites is
    computed about the ``new`` mean or about the ``old`` mean, which adds the squared step and slows the narrowing.
    """

    name = "cem"

    elites: int = param(20, "best points, to which the next normal is fitted", low=1)
    width: float = param(1.0, "initial standard deviation, in units of theta", positive=True)
    least: float = param(1e-6, "smallest standard deviation", low=0.0)
    spread: str = param("new", "mean about which the variance is computed", choices=("new", "old"))

    def start(self, theta: np.ndarray) -> OptimizerState:
        """Return the initial state: mean theta, standard deviation ``width``."""
        return super().start(theta) | {"deviation": np.full(len(theta), self.width)}

    def ask(self, state: OptimizerState, noise: np.ndarray) -> np.ndarray:
        return state["theta"][:, None] + state["deviation"][:, None] * noise

    def tell(self, state: OptimizerState, theta: np.ndarray, answer: Answer) -> OptimizerState:
        """Return mean and standard deviation of the elites as state; points without a finite cost rank last."""
        elite = self.best(theta, answer, self.elites)
        mean = elite.mean(axis=1)
        about = mean if self.spread == "new" else state["theta"]
        deviation = np.sqrt(((elite - about[:, None]) ** 2).mean(axis=1))
        return {"theta": mean, "deviation": np.maximum(deviation, self.least)}
