"""Steps of a length found by trying several at once."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.model import Answer, Optimizer, OptimizerState, param


@dataclass(frozen=True)
class Searching(Optimizer):
    """A method that asks for a gradient, then for the costs of shrinking steps along its direction, all in one batch.

    The first step with f <= f0 + slope step g.direction is taken (Armijo 1966); without one theta stays. The batch
    begins with theta itself, so that all costs compared come from the same noise.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"value", "gradient"})

    first: float = param(0.1, "longest step that is tried", positive=True)
    shrink: float = param(0.2, "factor between two steps that are tried", positive=True, high=0.99)
    slope: float = param(0.2, "share of the promised descent that a step has to keep", positive=True, high=1.0)
    tries: int = param(8, "steps that are tried", positive=True)

    def start(self, theta: np.ndarray) -> OptimizerState:
        """Start by asking for a gradient."""
        return super().start(theta) | {"gradient": None}

    def required_fields(self, state: OptimizerState) -> frozenset[str]:
        """Return gradient and costs in turn."""
        return frozenset({"gradient"} if state["gradient"] is None else {"value"})

    def ask(self, state: OptimizerState, noise: np.ndarray) -> np.ndarray:
        """Return theta, or theta and the steps from it."""
        theta = state["theta"][:, None]
        if state["gradient"] is None:
            return np.array(theta)
        return np.asarray(theta + self.direction(state)[:, None] * np.concatenate([[0.0], self.steps(state)]))

    def tell(self, state: OptimizerState, theta: np.ndarray, answer: Answer) -> OptimizerState:
        """Note the gradient, or take the longest step that descends enough."""
        if state["gradient"] is None:
            assert answer.gradient is not None
            return self.with_gradient(state, answer.gradient[:, 0])
        assert answer.value is not None
        promised = self.slope * self.steps(state) * float(state["gradient"] @ self.direction(state))
        good = np.flatnonzero(answer.value[1:] <= answer.value[0] + promised)
        moved = theta[:, 1 + good[0]] if good.size else state["theta"]
        return state | {"theta": np.array(moved), "gradient": None}

    def steps(self, state: OptimizerState) -> np.ndarray:
        """Return the steps that are tried, longest first."""
        return self.first * self.shrink ** np.arange(self.tries)

    def with_gradient(self, state: OptimizerState, gradient: np.ndarray) -> OptimizerState:
        """Return the state with a new gradient."""
        return state | {"gradient": gradient}

    @abstractmethod
    def direction(self, state: OptimizerState) -> np.ndarray:
        """Return the direction of the steps, ``(d,)``."""
