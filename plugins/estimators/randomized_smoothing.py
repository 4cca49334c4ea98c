"""Randomized smoothing of the parameters."""

from dataclasses import dataclass

import numpy as np

from bench.model import Problem, Program, SampleMean, Smoothing, param


@dataclass(frozen=True)
class RandomizedSmoothing(SampleMean):
    """Approximates grad J_s with (f(theta + s w) - f(theta - s w)) w / 2s, or (f(theta + s w) - f(theta)) w / s.

    ``variant``: ``antithetic`` (2 rollouts per sample) or ``forward`` (1 per sample and 1 for the centre). The radius s
    is sigma by default. The smoothing is over theta, never over actions: under a feedback policy with action noise, or
    with another radius, the target is not J_sigma. With ``reference=own`` and noise on theta, the reference is the
    gradient of the estimator's own smoothing. Requires only costs (Nesterov, Spokoiny 2017).
    """

    name = "randomized_smoothing"
    needs_directions = True
    smooths_theta = True
    unbiased_at_discontinuities = True

    variant: str = param("antithetic", "central or forward difference", choices=("antithetic", "forward"))
    radius: float | None = param(
        None, "s, standard deviation of the smoothing, in units of theta; null: sigma", positive=True
    )
    reference: str = param(
        "sigma",
        "reference of its rows: J_sigma, or the estimator's own smoothing",
        choices=("sigma", "own"),
    )

    @property
    def pairs_samples(self) -> bool:  # type: ignore[override]
        """True for central differences. Forward differences of mirrored draws are central differences."""
        return self.variant == "antithetic"

    def terms(self, problem: Problem, theta: np.ndarray, w: np.ndarray) -> np.ndarray:
        s = problem.sigma if self.radius is None else self.radius
        direction = problem.directions(w)
        centred = problem.centred(w)
        ahead = problem.displaced(s * direction, theta, centred)
        if self.variant == "antithetic":
            return (ahead - problem.displaced(-s * direction, theta, centred)) * direction / (2 * s)
        centre = centred if problem.program.exogenous else centred[:, :1]
        return (ahead - problem.value(theta, centre)) * direction / s

    def declares_unbiased(self, program: Program) -> bool:
        """Return whether its smoothing equals its reference's: noise on theta, and J_sigma's radius or its own."""
        if self.smoothing(program) is not None:
            return True
        is_other = self.radius is not None and self.radius != program.scene.sigma
        return not is_other and super().declares_unbiased(program)

    def smoothing(self, program: Program) -> Smoothing | None:
        if self.reference == "sigma" or self.radius is None or not program.noise_on_theta:
            return None
        return Smoothing("gaussian", self.radius)
