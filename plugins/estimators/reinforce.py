"""Score-function (likelihood-ratio, zeroth-order) gradient."""

from dataclasses import dataclass

import numpy as np

from bench.model import Problem, SampleMean, columns, less_others, param, per_repeat


@dataclass(frozen=True)
class Reinforce(SampleMean):
    """Approximates grad J_sigma with the mean of (f - b) d log p(actions)/dtheta (Williams 1992).

    Baseline b: ``leave_one_out``, the mean cost of the other samples of the batch (Mohamed et al. 2020, section 7; needs 2
    samples); ``center``, f at w = 0; ``none``. Where f at w = 0 is far from the mean cost, as at a minimum, ``center`` leaves
    most of the variance. Requires costs and scores. Unbiased for any cost, even with jumps.
    """

    name = "reinforce"
    needs = frozenset({"value", "score"})
    unbiased_at_discontinuities = True

    baseline: str = param("leave_one_out", "baseline subtracted from f", choices=("leave_one_out", "center", "none"))

    @property
    def in_units(self) -> bool:  # type: ignore[override]
        """Whether the baseline is computed from samples."""
        return not self.separable

    @property
    def least_samples(self) -> int:  # type: ignore[override]
        """The baseline of a sample is the mean of others."""
        return 1 + self.in_units

    @property
    def separable(self) -> bool:
        """Whether the term of each sample depends on that sample only."""
        return self.baseline != "leave_one_out"

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return (f - b) * score of each sample, ``(d, B)``; ValueError if b depends on the other samples."""
        if not self.separable:
            raise ValueError(f"{self.name}[baseline={self.baseline}] has no terms of single samples: use estimate")
        f = problem.value(theta, w)
        if self.baseline == "center":
            f = f - problem.value(theta, np.zeros((w.shape[0], 1)))
        return f * problem.score(theta, w)

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the mean of the terms over samples, ``(R, d)``."""
        if self.separable:
            return super().estimate(problem, theta, noise)
        w = columns(noise)
        f = per_repeat(problem.value(theta, w), noise)
        f = less_others(f, self.design(problem.program, f.shape[1]).unit)
        score = per_repeat(problem.score(theta, w), noise)
        return np.einsum("rn,rnd->rd", f, score) / f.shape[1]
