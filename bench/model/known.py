"""Roles of scenes whose optimal control is known: the least cost, and the least cost to go from a state."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np


class KnownOptimum(ABC):
    """A role: the scene knows the least cost of all theta, without noise."""

    @abstractmethod
    def optimum(self) -> tuple[float, str]:
        """Return J* and how it is known."""


class KnownValue(ABC):
    """A role: the scene knows the least cost to go, so that a short window can end in it."""

    @abstractmethod
    def cost_to_go(self, q: np.ndarray, v: np.ndarray, step: int) -> np.ndarray:
        """Return the least cost from the state before ``step`` on, without noise, ``(B,)``; in NumPy."""
