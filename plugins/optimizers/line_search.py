"""Steepest descent with backtracking."""

from dataclasses import dataclass

import numpy as np

from bench.model import OptimizerState

from .searching import Searching


@dataclass(frozen=True)
class LineSearch(Searching):
    """Steepest descent with Armijo backtracking; the defaults are slope .2, shrink .2 and a first step of .1."""

    name = "line_search"

    def direction(self, state: OptimizerState) -> np.ndarray:
        return -np.asarray(state["gradient"])
