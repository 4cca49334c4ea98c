"""The contract of an optimizer, which computes the next theta from costs and gradient estimates."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from bench.host.parameters import Plugin, param

OptimizerState = dict[str, Any]
"""The complete state of an optimizer between two steps: arrays and numbers by name, including ``theta (d,)``."""


class Answer(NamedTuple):
    """Costs, gradients and residuals at the points of :meth:`Optimizer.ask`; None for fields that were not required."""

    value: np.ndarray = None  # type: ignore[assignment]
    """Costs, ``(B,)``."""
    gradient: np.ndarray = None  # type: ignore[assignment]
    """Gradient estimates, ``(d, B)``."""
    residual: np.ndarray = None  # type: ignore[assignment]
    """Residuals of a least-squares cost, ``(m, B)``. The cost is half the sum of their squares."""
    jacobian: np.ndarray = None  # type: ignore[assignment]
    """Derivatives of the residuals with respect to theta, ``(m, d, B)``."""


WANTED = frozenset(Answer._fields)


@dataclass(frozen=True)
class Optimizer(Plugin):
    """Minimises a cost through the ask-and-tell interface: :meth:`ask` returns points, :meth:`tell` receives the answer.

    The optimizer itself is stateless. Its state is a dictionary of arrays and numbers that can be pickled, so a search
    can be stopped between any two steps and resumed elsewhere along the same path. It draws no random numbers:
    :meth:`ask` receives the standard normal numbers that it needs.
    """

    kind: ClassVar[str] = "optimizers"
    needs: ClassVar[frozenset[str]] = frozenset({"gradient"})
    """The fields of :class:`Answer` that the optimizer uses in at least one step."""

    def start(self, theta: np.ndarray) -> OptimizerState:
        """Return the state before the first step, starting from ``theta (d,)``."""
        return {"theta": np.array(theta, dtype=np.float64)}

    def draws(self, dim: int) -> int:
        """Return the number of columns of ``noise`` that :meth:`ask` needs; 0 for an optimizer that does not sample."""
        return 0

    @abstractmethod
    def ask(self, state: OptimizerState, noise: np.ndarray) -> np.ndarray:
        """Return the points to evaluate, ``(d, B)``, from standard normal ``noise (d, draws)``."""

    def required_fields(self, state: OptimizerState) -> frozenset[str]:
        """Return the fields of the answer that the next step uses; by default :attr:`needs`."""
        return self.needs

    @abstractmethod
    def tell(self, state: OptimizerState, theta: np.ndarray, answer: Answer) -> OptimizerState:
        """Return the next state, given the answer at the points ``theta (d, B)``; the old state is not modified."""


@dataclass(frozen=True)
class Descent(Optimizer):
    """An optimizer that takes each step from one gradient at its current theta."""

    def ask(self, state: OptimizerState, noise: np.ndarray) -> np.ndarray:
        """Return the current theta, ``(d, 1)``."""
        return np.array(state["theta"][:, None])

    def tell(self, state: OptimizerState, theta: np.ndarray, answer: Answer) -> OptimizerState:
        """Return the state after one :meth:`step`."""
        return self.step(state, answer.gradient[:, 0])

    @abstractmethod
    def step(self, state: OptimizerState, gradient: np.ndarray) -> OptimizerState:
        """Return the state after one step along ``gradient (d,)``."""


@dataclass(frozen=True)
class Population(Optimizer):
    """An optimizer that evaluates the costs of points sampled around a mean."""

    needs: ClassVar[frozenset[str]] = frozenset({"value"})

    population: int = param(100, "points per iteration", low=2)

    def draws(self, dim: int) -> int:
        """Return the number of points."""
        return self.population

    @staticmethod
    def best(theta: np.ndarray, answer: Answer, count: int) -> np.ndarray:
        """Return the ``count`` points of lowest cost, ``(d, count)``; points without a finite cost rank last."""
        cost = np.where(np.isfinite(answer.value), answer.value, np.inf)
        return theta[:, np.argsort(cost, kind="stable")[:count]]
