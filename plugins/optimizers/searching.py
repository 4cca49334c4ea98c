"""The base class of the line-search methods, which evaluate several step lengths in one batch."""

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from bench.model import Answer, Optimizer, OptimizerState, param


@dataclass(frozen=True)
class Searching(Optimizer):
    """A method that alternates between requesting a gradient and the costs of several steps along a direction.

    It takes the longest step with f <= f0 + slope step g.direction (Armijo 1966). Without such a step, theta does not
    change. The batch of steps includes theta itself, so that all compared costs use the same noise.
    """

    needs = frozenset({"value", "gradient"})

    first: float = param(0.1, "longest trial step", positive=True)
    shrink: float = param(0.2, "factor between two trial steps", positive=True, high=0.99)
    slope: float = param(0.2, "required share of the predicted descent (Armijo)", positive=True, high=1.0)
    tries: int = param(8, "number of trial steps", positive=True)

    def start(self, theta: np.ndarray) -> OptimizerState:
        return super().start(theta) | {"gradient": None}

    def required_fields(self, state: OptimizerState) -> frozenset[str]:
        return frozenset({"gradient"} if state["gradient"] is None else {"value"})

    def ask(self, state: OptimizerState, noise: np.ndarray) -> np.ndarray:
        theta = state["theta"][:, None]
        if state["gradient"] is None:
            return np.array(theta)
        return theta + self.direction(state)[:, None] * np.concatenate([[0.0], self.steps(state)])

    def tell(self, state: OptimizerState, theta: np.ndarray, answer: Answer) -> OptimizerState:
        if state["gradient"] is None:
            return self.with_gradient(state, answer.gradient[:, 0])
        predicted = self.slope * self.steps(state) * float(state["gradient"] @ self.direction(state))
        accepted = np.flatnonzero(answer.value[1:] <= answer.value[0] + predicted)
        moved = theta[:, 1 + accepted[0]] if accepted.size else state["theta"]
        return state | {"theta": np.array(moved), "gradient": None}

    def steps(self, state: OptimizerState) -> np.ndarray:
        """Return the lengths of the trial steps, longest first, ``(tries,)``."""
        return self.first * self.shrink ** np.arange(self.tries)

    def with_gradient(self, state: OptimizerState, gradient: np.ndarray) -> OptimizerState:
        """Return the state with a new gradient."""
        return state | {"gradient": gradient}

    @abstractmethod
    def direction(self, state: OptimizerState) -> np.ndarray:
        """Return the direction of the steps, ``(d,)``."""
