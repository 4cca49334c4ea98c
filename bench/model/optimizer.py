"""Optimizers: how costs and gradient estimates become the next theta."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from bench.model.parameters import Plugin

State = dict[str, Any]
"""What an optimizer knows between two steps: arrays and numbers by name, ``theta (d,)`` among them."""


class Answer(NamedTuple):
    """What is known at the points that an optimizer has asked about; None for what it did not want."""

    value: np.ndarray | None = None
    """Costs, ``(B,)``."""
    gradient: np.ndarray | None = None
    """Gradient estimates, ``(d, B)``."""
    residual: np.ndarray | None = None
    """Residuals of a least-squares cost, ``(m, B)``: the cost is half the sum of their squares."""
    jacobian: np.ndarray | None = None
    """Their derivatives by theta, ``(m, d, B)``."""


WANTED = frozenset(Answer._fields)


@dataclass(frozen=True)
class Optimizer(Plugin):
    """Minimises a cost by asking about points: :meth:`ask`, then :meth:`tell` with the answer, again and again.

    The optimizer keeps nothing itself. All that it knows is in its state, a dictionary of arrays and numbers that can be
    pickled, so a search can be stopped between any two steps and resumed elsewhere along the same path. It draws
    nothing either: :meth:`ask` gets the standard normal numbers it needs.
    """

    kind: ClassVar[str] = "optimizers"
    needs: ClassVar[frozenset[str]] = frozenset({"gradient"})
    """The fields of :class:`Answer` that it uses at some step."""

    def start(self, theta: np.ndarray) -> State:
        """Return the state before the first step from ``theta (d,)``."""
        return {"theta": np.array(theta, dtype=np.float64)}

    def draws(self, dim: int) -> int:
        """Return how many columns of normal numbers :meth:`ask` needs; 0 unless it samples."""
        return 0

    @abstractmethod
    def ask(self, state: State, noise: np.ndarray) -> np.ndarray:
        """Return the points to evaluate, ``(d, B)``, from standard normal ``noise (d, draws)``."""

    def wants(self, state: State) -> frozenset[str]:
        """Return the fields of the answer that the next step uses; by default all of :attr:`needs`."""
        return self.needs

    @abstractmethod
    def tell(self, state: State, theta: np.ndarray, answer: Answer) -> State:
        """Return the state after the answer at the points ``theta (d, B)``; the old state stays as it is."""


@dataclass(frozen=True)
class Descent(Optimizer):
    """An optimizer that evaluates one gradient at its current theta and moves from there."""

    def ask(self, state: State, noise: np.ndarray) -> np.ndarray:
        """Return theta itself, ``(d, 1)``."""
        return np.array(state["theta"][:, None])

    def tell(self, state: State, theta: np.ndarray, answer: Answer) -> State:
        """Move by :meth:`step`."""
        assert answer.gradient is not None
        return self.step(state, answer.gradient[:, 0])

    @abstractmethod
    def step(self, state: State, gradient: np.ndarray) -> State:
        """Return the state after one step along ``gradient (d,)``."""


@dataclass(frozen=True)
class Population(Optimizer):
    """An optimizer that evaluates the costs of points sampled around a mean."""

    needs: ClassVar[frozenset[str]] = frozenset({"value"})
