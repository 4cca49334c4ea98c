"""Score-function (likelihood-ratio, zeroth-order) gradient."""

from dataclasses import dataclass

import numpy as np

from bench.model import Problem, SampleMean, columns, param, per_repeat, sums_of_units


@dataclass(frozen=True)
class Reinforce(SampleMean):
    """Approximates grad J_sigma with the mean of (f - b) d log p(actions)/dtheta (Williams 1992).

    Baseline b: ``none``; ``center``, f at w = 0; ``leave_one_out``, the mean cost of the other samples of the batch.
    Requires costs and scores. Unbiased for any cost, even with jumps.
    """

    name = "reinforce"
    needs = frozenset({"value", "score"})
    unbiased_at_discontinuities = True

    @property
    def in_units(self) -> bool:  # type: ignore[override]
        """Whether the baseline is computed from samples."""
        return not self.separable

    baseline: str = param("center", "baseline subtracted from f", choices=("none", "center", "leave_one_out"))

    @property
    def separable(self) -> bool:
        """Whether the term of each sample depends on that sample only."""
        return self.baseline != "leave_one_out"

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return (f - b) * score of each sample, ``(d, B)``."""
        f = problem.value(theta, w)
        if self.baseline == "center":
            f = f - problem.value(theta, np.zeros((w.shape[0], 1)))
        return f * problem.score(theta, w)

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the mean of the terms over samples, ``(R, d)``; ValueError if the baseline needs more samples."""
        if self.separable:
            return super().estimate(problem, theta, noise)
        if noise.shape[1] < 2:
            raise ValueError("baseline leave_one_out needs at least 2 samples")
        w = columns(noise)
        f = per_repeat(problem.value(theta, w), noise)
        n, unit = f.shape[1], self.design(problem.program, f.shape[1]).unit
        centred = f - f.mean(axis=1, keepdims=True)
        # the cost less the mean of the other units
        f = centred * n / (n - unit) + (sums_of_units(centred, unit) - unit * centred) / (n - unit)
        score = per_repeat(problem.score(theta, w), noise)
        return np.einsum("rn,rnd->rd", f, score) / f.shape[1]
