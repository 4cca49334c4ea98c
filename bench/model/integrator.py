"""The contract of an integrator, a time-stepping map."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bench.host.parameters import Plugin
from bench.model.dynamics import Dynamics
from bench.model.ops import Array, State


@dataclass(frozen=True)
class Integrator(Plugin):
    """A time-stepping map."""

    kind: ClassVar[str] = "integrators"
    order: ClassVar[int] = 1
    """Order of the global error in dt on smooth dynamics."""
    takes_impulses: ClassVar[bool] = False
    """Whether a step can apply an :class:`ImpulseLaw`."""
    moves_with: ClassVar[str] = ""
    """The velocity that moves the position, for a step with one acceleration, at its start: ``new`` or ``old``."""
    needs_root: ClassVar[bool] = False
    """Whether a step solves an equation, so that only backends with ``root`` can run it."""

    @abstractmethod
    def step(self, dynamics: Dynamics, state: State, u: Array, dt: Any) -> State:
        """Return the state after one step of length ``dt`` under the constant control ``u (n_u, B)``."""

    @abstractmethod
    def amplification(self, z: complex) -> complex:
        """Return the stability function R(z), z = a dt: one step of v' = a v, without positions, multiplies v by R."""

    @abstractmethod
    def transition(self, dt: float, stiffness: float, damping: float, factor: float) -> np.ndarray:
        """Return the matrix ``(2, 2)`` of one step of q' = v, v' = -stiffness q - damping v with a velocity ``factor``.

        The step is stable if the spectral radius is at most 1.
        """
