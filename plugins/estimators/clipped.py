"""First-order gradient with its large values cut."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from bench.model import Auxiliaries, DiagnosticEstimator, Problem, first_order, param


@dataclass(frozen=True)
class Clipped(DiagnosticEstimator):
    """Approximates grad J_sigma with the mean of sampled gradients, cut at ``limit`` (Pascanu et al. 2013 cut norms).

    ``by``: ``sample``, each sample's norm; ``element``, each coordinate of each sample; ``batch``, the norm of the mean.
    The limit is by default a quantile of the samples' sizes in the same batch, so that it follows the problem's scale.
    Requires gradients. Biased: what is cut is missing from the mean; on a ramp of width nu, cut at c, with chance p to
    hit it, the expectation is c p instead of (2 / nu) p. Reports the share that was ``cut``.
    """

    name = "clipped"
    needs = frozenset({"grad"})
    unbiased = False
    diagnostics: ClassVar[tuple[str, ...]] = ("cut",)

    by: str = param("sample", "what is cut", choices=("sample", "batch", "element"))
    limit: float | None = param(
        None, "largest size, in units of the gradient; null: that quantile of the batch", positive=True
    )
    quantile: float = param(0.9, "share of the samples' sizes below the limit where limit is null", low=0.0, high=1.0)

    def estimate_with_diagnostics(
        self, problem: Problem, theta: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, Auxiliaries]:
        """Return the estimates, and the share of sizes that were cut, ``(R,)``."""
        terms = first_order(problem, theta, noise)
        sizes = np.abs(terms) if self.by == "element" else np.linalg.norm(terms, axis=-1, keepdims=True)
        limit = np.quantile(sizes, self.quantile, axis=1, keepdims=True) if self.limit is None else self.limit
        if self.by == "batch":
            terms = terms.mean(axis=1, keepdims=True)
            sizes = np.linalg.norm(terms, axis=-1, keepdims=True)
        # a size of 0 stays 0, whatever it is multiplied by
        factor = np.minimum(1.0, np.divide(limit, sizes, out=np.ones_like(sizes), where=sizes > 0))
        return (factor * terms).mean(axis=1), {"cut": (factor < 1.0).mean(axis=(1, 2))}
