"""Roles of scenes with known solutions: the optimal cost, the optimal cost-to-go, and parameters to identify."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from bench.model.contact import ContactLaw
from bench.model.parameters import Plugin


class KnownOptimum(ABC):
    """A role: the scene knows its optimal cost over theta, without noise."""

    @abstractmethod
    def optimum(self, contact: ContactLaw | None, integrator: Plugin | None) -> tuple[float, str] | None:
        """Return J* under this law and integrator and the method that gives it, or None if it is not known."""


class KnownValue(ABC):
    """A role: the scene knows its optimal cost-to-go, which a short window can use as its terminal cost."""

    @abstractmethod
    def cost_to_go(self, q: np.ndarray, v: np.ndarray, step: int) -> np.ndarray:
        """Return the optimal cost-to-go from the state before ``step``, without noise, ``(B,)``, in NumPy."""


class Identified(ABC):
    """A role: some parameters of the scene are to be identified from a record of its motion."""

    unknowns: ClassVar[tuple[str, ...]]
    """Names of the parameters to identify, unless the user names others."""
    measured: ClassVar[tuple[int, ...] | None] = None
    """Indices of the positions measured after each step; None for all."""
    end_only: ClassVar[bool] = False
    """Whether only the final positions are measured."""
