"""Model-predictive path integral control, as an optimizer."""

from dataclasses import dataclass

import numpy as np

from bench.model import Answer, OptimizerState, Population, param


@dataclass(frozen=True)
class Mppi(Population):
    """The mean of normal samples weighted by exp(-cost / temperature) (Williams et al. 2017).

    On the cost (u - u*)'H (u - u*) / 2, with variance S and infinitely many samples, the mean moves from mu to
    (H / temperature + S^-1)^-1 (H u* / temperature + S^-1 mu). At a high temperature this is a zeroth-order gradient
    step with rate S / temperature; at a low temperature it is the best sample.
    """

    name = "mppi"

    width: float = param(0.3, "standard deviation of the samples, in units of theta", positive=True)
    temperature: float = param(1.0, "increase of the cost at which a weight falls to 1/e", positive=True)
    relative: bool = param(True, "whether the temperature is in units of the standard deviation of the costs")

    def ask(self, state: OptimizerState, noise: np.ndarray) -> np.ndarray:
        return state["theta"][:, None] + self.width * noise

    def tell(self, state: OptimizerState, theta: np.ndarray, answer: Answer) -> OptimizerState:
        """Return the weighted mean as state; points without a finite cost have weight 0."""
        is_finite = np.isfinite(answer.value)
        if not is_finite.any():
            return state
        cost = answer.value[is_finite]
        unit = float(cost.std()) if self.relative else 1.0
        weight = np.exp(-(cost - cost.min()) / (self.temperature * (unit or 1.0)))
        return {"theta": theta[:, is_finite] @ (weight / weight.sum())}
