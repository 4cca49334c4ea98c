"""Zeroth order along directions of equal length."""

from dataclasses import dataclass

import numpy as np

from bench.model import Problem, Program, SampleMean, Smoothing, param


@dataclass(frozen=True)
class SphereSmoothing(SampleMean):
    """Approximates grad J_sigma with d (f(theta + r u) - f(theta - r u)) u / 2r, u uniform on the unit sphere.

    Its expectation is the gradient of the cost averaged over a *ball* of radius r. By default r = sigma sqrt(d + 2),
    for which ball and Gaussian have the same covariance and agree for cubic costs. For other costs they differ, so it
    is declared biased, unless the reference is the ball itself (``reference=own``). On a linear cost its relative
    squared error is (d - 1) / N, while Gaussian directions give (d + 1) / N (Flaxman et al. 2005; Berahas et al. 2022).
    Requires only costs.
    """

    name = "sphere_smoothing"
    needs_directions = True
    pairs_samples = True
    unbiased = False

    radius: float | None = param(None, "r, in units of theta; null: sigma sqrt(d + 2)", positive=True)
    reference: str = param(
        "sigma",
        "reference of its rows: J_sigma, or the estimator's own smoothing",
        choices=("sigma", "own"),
    )

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        d = problem.dim
        r = self._radius(problem.program)
        normal = problem.directions(w)
        u = normal / np.linalg.norm(normal, axis=0)
        centred = problem.centred(w)
        change = problem.displaced(r * u, theta, centred) - problem.displaced(-r * u, theta, centred)
        return d * change * u / (2.0 * r)

    def _radius(self, program: Program) -> float:
        return float(program.scene.sigma * np.sqrt(program.dim + 2.0)) if self.radius is None else self.radius

    def smoothing(self, program: Program) -> Smoothing | None:
        return Smoothing("ball", self._radius(program)) if self.reference == "own" else None

    def declares_unbiased(self, program: Program) -> bool:
        """Return whether the reference is the smoothing over the ball, for which it is unbiased for any cost."""
        return self.reference == "own"
