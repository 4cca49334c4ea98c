"""Scenes whose cost is code of the user's own, which no array namespace can run: a simulator as it is."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from bench.model.scene import Scene

if TYPE_CHECKING:
    from bench.model.simulator import Simulator


@dataclass(frozen=True)
class CallableScene(Scene):
    """A scene whose cost is a function of theta, or of theta and noise w of its own, as its author wrote it.

    f(theta, w) = cost(theta + sigma u, v) with w = (u, v): d numbers of noise on theta, then those of the cost itself. Its
    cost counts as discontinuous, since nobody says that it is not.
    """

    continuous: ClassVar[bool] = False

    @abstractmethod
    def simulator(self) -> Simulator:
        """Return the cost and its gradient as functions of columns, the same object at each call."""

    @abstractmethod
    def files(self) -> tuple[Path, ...]:
        """Return the files whose code decides the cost: when one changes, its cells run again."""

    def theta0(self) -> np.ndarray:
        """Return theta as a vector, ``(d,)``."""
        return self.simulator().layout.vector
