"""First-order gradient with clipping."""

from dataclasses import dataclass

import numpy as np

from bench.model import Auxiliaries, DiagnosticEstimator, Problem, first_order, param, per_unit


@dataclass(frozen=True)
class Clipped(DiagnosticEstimator):
    """Approximates grad J_sigma with the mean of sampled gradients clipped at ``limit`` (norm clipping: Pascanu et al. 2013).

    ``by``: ``sample``, each sample's norm; ``element``, each coordinate of each sample; ``batch``, the norm of the
    mean. The limit is by default a quantile of the samples' sizes in the same batch, so that it follows the problem's
    scale. Requires gradients. Biased, since the clipped part is missing from the mean: on a ramp of width nu that a
    sample hits with probability p, clipping at c gives the expectation c p instead of (2 / nu) p. Of samples that are
    drawn together, their mean is clipped (De et al. 2022, section 3.1: augmentations of an example). Reports the clipped
    share as ``cut``.
    """

    name = "clipped"
    needs = frozenset({"grad"})
    unbiased = False
    in_units = True
    diagnostics = ("cut",)

    by: str = param("sample", "what is clipped", choices=("sample", "batch", "element"))
    limit: float | None = param(
        None, "largest size, in units of the gradient; null: the quantile of the batch", positive=True
    )
    quantile: float = param(0.9, "share of the samples' sizes below the limit if limit is null", low=0.0, high=1.0)

    def estimate_with_diagnostics(
        self, problem: Problem, theta: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, Auxiliaries]:
        """Return the estimates ``(R, d)``, and the share of clipped sizes as ``cut``, ``(R,)``."""
        terms = per_unit(first_order(problem, theta, noise), self.design(problem.program, noise.shape[1]).unit)
        sizes = np.abs(terms) if self.by == "element" else np.linalg.norm(terms, axis=-1, keepdims=True)
        limit = np.quantile(sizes, self.quantile, axis=1, keepdims=True) if self.limit is None else self.limit
        if self.by == "batch":
            terms = terms.mean(axis=1, keepdims=True)
            sizes = np.linalg.norm(terms, axis=-1, keepdims=True)
        # a size of 0 is 0 with any factor
        factor = np.minimum(1.0, np.divide(limit, sizes, out=np.ones_like(sizes), where=sizes > 0))
        return (factor * terms).mean(axis=1), {"cut": (factor < 1.0).mean(axis=(1, 2))}
