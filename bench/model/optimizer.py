"""The contract of an optimizer, which computes the next theta from costs and gradient estimates."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from bench.model.parameters import Plugin

if TYPE_CHECKING:
    from bench.model.backend import Backend
    from bench.model.problem import Problem
    from bench.model.program import Program

State = dict[str, Any]
"""The complete state of an optimizer between two steps: arrays and numbers by name, including ``theta (d,)``."""


class Expansion(NamedTuple):
    """The rollout of T controls without noise, with derivatives of its steps and costs.

    m is the length of a control and k of a change of the state. Second derivatives of the steps are not included.
    """

    controls: np.ndarray
    """``(T, m)``."""
    a: np.ndarray
    """d next state / d state, ``(T, k, k)``."""
    b: np.ndarray
    """d next state / d control, ``(T, k, m)``."""
    cost: float
    """Sum of the stage costs and the terminal cost."""
    cost_x: np.ndarray
    """Derivatives of the stage costs and of the terminal cost by the state, ``(T + 1, k)``."""
    cost_u: np.ndarray
    """Derivatives of the stage costs by the control, ``(T, m)``."""
    cost_xx: np.ndarray
    """``(T + 1, k, k)``."""
    cost_ux: np.ndarray
    """``(T, m, k)``."""
    cost_uu: np.ndarray
    """``(T, m, m)``."""
    follow: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    """From plans ``(T, m, B)`` and gains ``(T, m, k)``: the controls ``(T, m, B)`` and costs ``(B,)`` of B rollouts.

    The controls are the plan plus the gains times the change of the state from this rollout.
    """


class Answer(NamedTuple):
    """Costs, gradients and residuals at the points of :meth:`Optimizer.ask`; None for fields that were not required."""

    value: np.ndarray | None = None
    """Costs, ``(B,)``."""
    gradient: np.ndarray | None = None
    """Gradient estimates, ``(d, B)``."""
    residual: np.ndarray | None = None
    """Residuals of a least-squares cost, ``(m, B)``. The cost is half the sum of their squares."""
    jacobian: np.ndarray | None = None
    """Derivatives of the residuals with respect to theta, ``(m, d, B)``."""
    path: Expansion | None = None
    """The noise-free rollout at the only point, with the derivatives of its steps and costs."""


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

    def start(self, theta: np.ndarray) -> State:
        """Return the state before the first step, starting from ``theta (d,)``."""
        return {"theta": np.array(theta, dtype=np.float64)}

    def draws(self, dim: int) -> int:
        """Return the number of columns of ``noise`` that :meth:`ask` needs; 0 for an optimizer that does not sample."""
        return 0

    @abstractmethod
    def ask(self, state: State, noise: np.ndarray) -> np.ndarray:
        """Return the points to evaluate, ``(d, B)``, from standard normal ``noise (d, draws)``."""

    def required_fields(self, state: State) -> frozenset[str]:
        """Return the fields of the answer that the next step uses; by default :attr:`needs`."""
        return self.needs

    def unsupported_reason(self, program: Program) -> str | None:
        """Return why this optimizer's own limits exclude the program, or None."""
        return None

    def expansion(self, problem: Problem, backend: Backend, theta: np.ndarray) -> Expansion:
        """Return the field ``path`` of the answer at ``theta (d,)``; an optimizer that needs it is a `PathOptimizer`."""
        raise NotImplementedError(f"optimizer {self.name} needs path: derive it from PathOptimizer")

    @abstractmethod
    def tell(self, state: State, theta: np.ndarray, answer: Answer) -> State:
        """Return the next state, given the answer at the points ``theta (d, B)``; the old state is not modified."""


@dataclass(frozen=True)
class Descent(Optimizer):
    """An optimizer that takes each step from one gradient at its current theta."""

    def ask(self, state: State, noise: np.ndarray) -> np.ndarray:
        """Return the current theta, ``(d, 1)``."""
        return np.array(state["theta"][:, None])

    def tell(self, state: State, theta: np.ndarray, answer: Answer) -> State:
        """Return the state after one :meth:`step`."""
        assert answer.gradient is not None
        return self.step(state, answer.gradient[:, 0])

    @abstractmethod
    def step(self, state: State, gradient: np.ndarray) -> State:
        """Return the state after one step along ``gradient (d,)``."""


@dataclass(frozen=True)
class Population(Optimizer):
    """An optimizer that evaluates the costs of points sampled around a mean."""

    needs: ClassVar[frozenset[str]] = frozenset({"value"})
