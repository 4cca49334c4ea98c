"""Limited-memory BFGS."""

from dataclasses import dataclass

import numpy as np

from bench.model import OptimizerState, param

from .searching import Searching


@dataclass(frozen=True)
class Lbfgs(Searching):
    """L-BFGS by the two-loop recursion (Nocedal, Wright 2006, algorithm 7.4) with Armijo backtracking from step 1.

    For gradients without noise. Pairs of step s and gradient change y with y.s <= 1e-10 |y||s| are skipped. Before the
    first pair, the direction is the negative gradient scaled to length ``first_move``.
    """

    name = "lbfgs"

    first: float = 1.0
    shrink: float = 0.5
    slope: float = 1e-4
    tries: int = 16
    memory: int = param(10, "stored pairs of steps and gradient differences", positive=True)
    first_move: float = param(0.1, "length of the first step", positive=True)

    def start(self, theta: np.ndarray) -> OptimizerState:
        return super().start(theta) | {"steps": [], "changes": [], "last": None}

    def with_gradient(self, state: OptimizerState, gradient: np.ndarray) -> OptimizerState:
        steps, changes = state["steps"], state["changes"]
        if state["last"] is not None:
            s, y = state["theta"] - state["last"][0], gradient - state["last"][1]
            if y @ s > 1e-10 * np.linalg.norm(y) * np.linalg.norm(s):
                steps, changes = [*steps, s][-self.memory :], [*changes, y][-self.memory :]
        return state | {
            "gradient": gradient,
            "steps": steps,
            "changes": changes,
            "last": (state["theta"], gradient),
        }

    def direction(self, state: OptimizerState) -> np.ndarray:
        q = state["gradient"]
        pairs = list(zip(state["steps"], state["changes"], strict=True))
        if not pairs:
            return -q * (self.first_move / (np.linalg.norm(q) + 1e-300))
        shares = []
        for s, y in reversed(pairs):
            shares.append((s @ q) / (y @ s))
            q = q - shares[-1] * y
        s, y = pairs[-1]
        q = q * ((s @ y) / (y @ y))
        for (s, y), share in zip(pairs, reversed(shares), strict=True):
            q = q + s * (share - (y @ q) / (y @ s))
        return -q
