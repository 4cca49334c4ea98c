"""Roles (mixins) of scenes with known solutions: the optimal cost, the optimal cost-to-go, parameters to identify."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from bench.host.parameters import Plugin
from bench.model.contact import ContactLaw


class KnownOptimum(ABC):
    """A role: the scene's optimal cost over theta, without noise, is known."""

    @abstractmethod
    def optimum(self, contact: ContactLaw | None, integrator: Plugin | None) -> tuple[float, str] | None:
        """Return the optimal cost J* under this law and integrator, and how it was computed; None if unknown."""


class KnownValue(ABC):
    """A role: the scene's optimal cost-to-go is known, for use as the terminal cost of a shorter horizon."""

    @abstractmethod
    def cost_to_go(self, q: np.ndarray, v: np.ndarray, step: int) -> np.ndarray:
        """Return the optimal cost-to-go from the state before ``step``, without noise, ``(B,)``."""


class Identified:
    """A role: some parameters of the scene are to be identified from a record of its motion."""

    unknowns: ClassVar[tuple[str, ...]] = ()
    """Default names of the parameters to identify."""
    measured: ClassVar[tuple[int, ...] | None] = None
    """Indices of the entries of the state (q, v) measured after each step; None for all positions."""
    end_only: ClassVar[bool] = False
    """Whether only the final positions are measured."""
