"""Roles of scenes with a known answer: the least cost, the least cost to go, and parameters that a record can tell."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from bench.model.contact import ContactLaw
from bench.model.parameters import Plugin


class KnownOptimum(ABC):
    """A role: the scene knows the least cost of all theta, without noise."""

    @abstractmethod
    def optimum(self, contact: ContactLaw | None, integrator: Plugin | None) -> tuple[float, str] | None:
        """Return J* under that law and integrator and how it is known; None where it is not known for them."""


class KnownValue(ABC):
    """A role: the scene knows the least cost to go, so that a short window can end in it."""

    @abstractmethod
    def cost_to_go(self, q: np.ndarray, v: np.ndarray, step: int) -> np.ndarray:
        """Return the least cost from the state before ``step`` on, without noise, ``(B,)``; in NumPy."""


class Identified(ABC):
    """A role: a record of the scene's motion is meant to say something about some of its parameters."""

    unknowns: ClassVar[tuple[str, ...]]
    """The parameters to find, unless the user names others."""
    measured: ClassVar[tuple[int, ...] | None] = None
    """Which positions are measured after each step; None for all."""
    end_only: ClassVar[bool] = False
    """Whether only the end is measured."""
