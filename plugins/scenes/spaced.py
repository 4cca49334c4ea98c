"""Base of plain functions of any number of variables, at evenly spaced numbers."""

from dataclasses import dataclass

import numpy as np

from bench.model import FunctionScene, param


@dataclass(frozen=True)
class SpacedScene(FunctionScene):
    """A role: a plain function of ``dimension`` variables."""

    dimension: int = param(5, "d, length of theta", positive=True)

    def theta0(self) -> np.ndarray:
        """Return numbers evenly spaced from 0.5 to 1.5."""
        return np.linspace(0.5, 1.5, self.dimension)
