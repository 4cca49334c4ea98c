"""Scenes whose cost is a user's own simulator, which no array namespace can run."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from bench.model.scene import Scene

if TYPE_CHECKING:
    from bench.simulator import Simulator


@dataclass(frozen=True)
class CallableScene(Scene):
    """A scene whose cost is a user's function of theta, or of theta and its own noise.

    f(theta, w) = cost(theta + sigma u, v) with w = (u, v): d numbers of noise on theta, then the cost's own noise. The
    cost is declared discontinuous, since it may have jumps.
    """

    continuous: ClassVar[bool] = False

    @abstractmethod
    def simulator(self) -> Simulator:
        """Return the cost and its gradient as functions of batches ``(d, B)``; the same object at each call."""

    @property
    def exogenous(self) -> int:  # type: ignore[override]
        """Number of the simulator's own normal numbers."""
        return self.simulator().noise

    @abstractmethod
    def files(self) -> tuple[Path, ...]:
        """Return the source files of the cost. If one changes, the scene's cells run again."""

    def theta0(self) -> np.ndarray:
        """Return the simulator's theta as a vector, ``(d,)``."""
        return self.simulator().layout.vector
