"""Zeroth order in the subspace that first-order gradients span."""

from dataclasses import dataclass

import numpy as np

from bench.model import Estimator, Problem, first_order, mean_difference, param


@dataclass(frozen=True)
class Guided(Estimator):
    """Approximates grad J_sigma with central differences along v = P w + sqrt(share) (1 - P) w.

    P projects onto the span of the gradients of the first ``subspace`` samples. The differences use the other samples.
    On a linear cost, the expectation is the gradient inside the subspace and ``share`` times it outside, while the
    variance falls from d + 1 to about ``subspace`` + share d squared gradients. This is useful if gradients lie in
    the correct subspace with wrong lengths and signs, and useless if they vanish (Maheswaranathan et al. 2019, guided
    evolutionary strategies). Requires costs and gradients, and more samples than ``subspace``. Biased.
    """

    name = "guided"
    needs_directions = True
    needs_independent_samples = True
    needs = frozenset({"value", "grad"})
    unbiased = False

    subspace: int = param(4, "samples whose gradients span the subspace", positive=True)
    share: float = param(0.1, "share of the gradient outside the subspace in the expectation", low=0.0, high=1.0)

    @property
    def least_samples(self) -> int:  # type: ignore[override]
        """One more than span the subspace."""
        return self.subspace + 1

    def estimate(self, problem: Problem, theta: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the mean of the differences along guided directions, ``(R, d)``."""
        first, rest = noise[:, : self.subspace], noise[:, self.subspace :]
        gradients = first_order(problem, theta, first)
        _, sizes, basis = np.linalg.svd(gradients, full_matrices=False)
        # exclude directions that are only rounding errors; gradients of 0 span no direction
        basis = basis * (sizes > 1e-9 * sizes.max(axis=1, keepdims=True))[..., None]
        w = rest[..., : problem.dim]
        inside = np.einsum("rkd,rke,rne->rnd", basis, basis, w)
        return mean_difference(problem, theta, inside + np.sqrt(self.share) * (w - inside), rest)
