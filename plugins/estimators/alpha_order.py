"""Interpolation between first and zeroth order with a confidence test."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bench.model import Auxiliaries, DiagnosticEstimator, Problem, first_order, halves, param, per_unit, zeroth_order


@dataclass(frozen=True)
class AlphaOrder(DiagnosticEstimator):
    """Approximates grad J_sigma with a fobg + (1 - a) zobg, the weight a chosen by a confidence test (Suh et al. 2022).

    With v1, v0 the variances of the two means, a = v0 / (v1 + v0) when the zeroth-order mean is known to within
    gamma, capped so that |a (fobg - zobg)| <= gamma - eps; a = 0 when it is not. Confidence radius
    eps = sqrt(2 V ln((d+1)/delta) / N) + (2 L / 3 N) ln((d+1)/delta), V the per-sample zeroth-order variance.
    By default gamma is ``ratio`` eps: a fixed gamma far below eps reduces the method to the zeroth order on fewer
    samples. A ratio of 1.25 caps a in many estimates of a smooth cost of one variable, at 4 to 20 times the variance. A
    larger ratio admits more of a jump's bias, up to (ratio - 1) eps. The two orders use the same samples, or
    independent halves of them (``sharing=split``, with half of the evaluations), where the published code draws N samples
    for each. Of draws that are not independent, N, V and L count units and the means over them. Reports a as ``alpha``,
    and ``eps``.
    Requires costs, gradients and scores. Biased by at most about gamma - eps, since a depends on the samples.
    """

    name = "alpha_order"
    needs = frozenset({"value", "grad", "score"})
    unbiased = False
    in_units = True
    diagnostics = ("alpha", "eps")

    gamma: float | None = param(
        None,
        "required accuracy of the zeroth-order mean, in units of the gradient; null: ratio times eps",
        positive=True,
    )
    ratio: float = param(1.5, "gamma / eps if gamma is null", low=1.0)
    sharing: str = param("shared", "whether both orders use the same samples", choices=("shared", "split"))
    delta: float = param(0.05, "failure probability of the confidence radius", positive=True, high=1.0)
    bound: float | None = param(None, "L, bound on |zeroth-order term|; null: the largest in the batch", positive=True)

    @property
    def least_samples(self) -> int:  # type: ignore[override]
        """Two for a variance, in each half."""
        return 4 if self.sharing == "split" else 2

    def remark(self, diagnostics: Mapping[str, Mapping[str, float]]) -> str:
        """Return a doubt where few estimates reach the cap, and differ from the others by much more than these vary."""
        ratio = self.ratio if self.gamma is None else self.gamma / max(diagnostics["eps"]["median"], 1e-300)
        # from gamma / eps = 2 on, hardly any estimate of a smooth cost reaches the cap; above a weight of .9, the first
        # order's variance is below a ninth of the zeroth order's
        if 1.0 < ratio < 2.0 and diagnostics["alpha"]["median"] > 0.9:
            return "rare estimates, in which gamma - eps limits alpha, hold most of the variance: its intervals are too narrow"
        return ""

    def estimate_with_diagnostics(
        self, problem: Problem, theta: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, Auxiliaries]:
        """Return the estimates ``(R, d)`` with alpha and eps, each ``(R,)``."""
        unit = self.design(problem.program, noise.shape[1]).unit
        if self.sharing == "split":
            first, zeroth = halves(problem, theta, noise, unit)
        else:
            orders = first_order(problem, theta, noise), zeroth_order(problem, theta, noise)
            first, zeroth = (per_unit(terms, unit) for terms in orders)
        n = zeroth.shape[1]
        fobg, zobg = first.mean(axis=1), zeroth.mean(axis=1)
        per_sample = zeroth.var(axis=1, ddof=1).sum(axis=-1)
        v0 = per_sample / n
        v1 = first.var(axis=1, ddof=1).sum(axis=-1) / first.shape[1]
        largest = np.linalg.norm(zeroth, axis=-1).max(axis=1) if self.bound is None else self.bound
        log_term = np.log((zeroth.shape[2] + 1) / self.delta)
        eps = np.sqrt(2 * per_sample * log_term / n) + 2 * largest / (3 * n) * log_term
        gamma = self.ratio * eps if self.gamma is None else self.gamma
        total = v0 + v1
        # if both variances are 0, any weight is correct
        alpha = np.divide(v0, total, out=np.ones_like(total), where=total > 0)
        distance = np.linalg.norm(fobg - zobg, axis=-1)
        margin = np.maximum(gamma - eps, 0.0)  # 0 if the zeroth-order mean is not known to within gamma
        cap = np.divide(margin, distance, out=np.full_like(distance, np.inf), where=distance > 0)
        alpha = np.minimum(alpha, cap)
        weight = alpha[:, None]
        return weight * fobg + (1 - weight) * zobg, {"alpha": alpha, "eps": eps}
