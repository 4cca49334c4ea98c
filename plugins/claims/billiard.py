"""C15: a ball that misses has gradient 0, and contact forces at a distance make the gradient nonzero."""

from __future__ import annotations

import numpy as np

from bench.claims.claim import Claim, Figure, Outcome
from bench.claims.toolkit import problem

SIGMA = 0.3


class Missed(Claim):
    """A billiard shot."""

    name = "C15"
    lesson = "The price of smoothing"
    statement = (
        "Where a ball misses another the gradient is exactly 0; hard in the forward pass and smooth in the backward one "
        "(contacts from distance), it is 0 nowhere."
    )
    source = "Paulus et al. 2025, arXiv 2506.14186; shares from the geometry"
    learned = (
        "A surrogate gradient sees what was missed and keeps the motion, but it is not the derivative of the program."
    )
    labels = ("force across u0 [N]", "df / du0")
    curves = {"truth": "true", "plain": "plain", "surrogate": "surrogate"}
    quick = False

    def measure(self) -> Outcome:
        """Count exact zeros over u0 in [-5, 5], and compare the smoothed gradients with the true one."""
        # an even count: at 0 every gradient is 0 by symmetry
        u = np.linspace(-5, 5, 2000)
        wide = np.linspace(-6.8, 6.8, 2721)
        step = wide[1] - wide[0]
        found = {}
        for name, law in (("plain", "penalty"), ("surrogate", "straight_through")):
            at = problem("billiard", law)
            gradient = at.grad(u[None], np.zeros((1, u.size)))[0]
            everywhere = at.grad(wide[None], np.zeros((1, wide.size)))[0]
            cost = at.value(wide[None], np.zeros((1, wide.size)))
            found[name] = (gradient, everywhere, cost)
        weights = np.exp(-0.5 * (np.arange(-360, 361) * step / SIGMA) ** 2)
        weights /= weights.sum()
        inside = slice(360, -360)
        smooth_cost = np.convolve(found["plain"][2], weights, "same")
        truth = np.gradient(smooth_cost, step)[inside]
        size = _root_mean_square(truth)
        bias, means = {}, {}
        for name, (_, everywhere, _) in found.items():
            means[name] = np.convolve(everywhere, weights, "same")[inside]
            bias[name] = _root_mean_square(means[name] - truth) / size
        plain, surrogate = found["plain"][0], found["surrogate"][0]
        hits = np.abs(u[plain != 0]).max()
        missed = np.abs(wide[inside]) > 2.6
        pushes = {name: float(np.mean(np.abs(mean[missed]) > 1e-3)) for name, mean in means.items()}
        figures = [
            # 2,000 values of u0 are 0.005 apart: the share and the widest hit are known to one value
            Figure("share of exact zeros", "0.562", float(np.mean(plain == 0)), spread=1 / u.size),
            Figure("widest hit", "2.189", float(hits), spread=float(u[1] - u[0])),
            Figure("share of exact zeros with contacts from distance", "0.0000", float(np.mean(surrogate == 0))),
            Figure(
                "largest difference of the costs",
                "0.000000000000",
                float(np.abs(found["plain"][2] - found["surrogate"][2]).max()),
            ),
        ]
        return Outcome(
            figures,
            reservation=(
                f"the surrogate is not the derivative of the program: smoothed with sigma {SIGMA:g} its mean is off by "
                f"{bias['surrogate']:.0%} of the true gradient's root mean square, the plain one's by {bias['plain']:.1%}; "
                f"beyond |u0| = 2.6, where the true gradient is 0, it pushes at {pushes['surrogate']:.0%} of the forces"
            ),
            series={
                "u": wide[inside][::8],
                "truth": truth[::8],
                "plain": means["plain"][::8],
                "surrogate": means["surrogate"][::8],
            },
        )


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
