"""C15: a ball that misses has gradient 0, and contact forces at a distance make the gradient nonzero."""

from __future__ import annotations

import numpy as np

from bench.claims import Claim, Figure, Outcome
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
    origin = "recomputed"
    learned = "A surrogate gradient sees what was missed, and is not the program's derivative. It keeps the motion."
    quantity = "df / du0"
    quick = False

    def measure(self) -> Outcome:
        """Count exact zeros over u0 in [-5, 5], and compare the smoothed gradients with the true one."""
        # an even count: at 0 every gradient is 0 by symmetry
        u = np.linspace(-5, 5, 2000)
        wide = np.linspace(-6.8, 6.8, 2721)
        step = wide[1] - wide[0]
        laws = {"plain": problem("billiard", "penalty"), "surrogate": problem("billiard", "straight_through")}
        still = np.zeros((1, wide.size))
        plain, surrogate = (at.grad(u[None], still[:, : u.size])[0] for at in laws.values())
        plain_cost, surrogate_cost = (at.value(wide[None], still) for at in laws.values())
        weights = np.exp(-0.5 * (np.arange(-360, 361) * step / SIGMA) ** 2)
        weights /= weights.sum()
        inside = slice(360, -360)
        truth = np.gradient(np.convolve(plain_cost, weights, "same"), step)[inside]
        means = {name: np.convolve(at.grad(wide[None], still)[0], weights, "same")[inside] for name, at in laws.items()}
        bias = {name: _root_mean_square(mean - truth) / _root_mean_square(truth) for name, mean in means.items()}
        pushes = np.mean(np.abs(means["surrogate"][np.abs(wide[inside]) > 2.6]) > 1e-3)
        figures = [
            # 2,000 values of u0 are 0.005 apart: the share and the widest hit are known to one value
            Figure("share of exact zeros", "0.562", float(np.mean(plain == 0)), spread=1 / u.size),
            Figure("widest hit", "2.189", float(np.abs(u[plain != 0]).max()), spread=float(u[1] - u[0])),
            Figure("share of exact zeros with contacts from distance", "0.0000", float(np.mean(surrogate == 0))),
            Figure(
                "largest difference of the costs", "0.000000000000", float(np.abs(plain_cost - surrogate_cost).max())
            ),
        ]
        return Outcome(
            figures,
            reservation=(
                f"the surrogate is not the derivative of the program: smoothed with sigma {SIGMA:g} its mean is off by "
                f"{bias['surrogate']:.0%} of the true gradient's root mean square, the plain one's by {bias['plain']:.1%}; "
                f"beyond |u0| = 2.6, where the true gradient is 0, it pushes at {pushes:.0%} of the forces"
            ),
            series={name: v[::8] for name, v in {"force across u0 [N]": wide[inside], "true": truth, **means}.items()},
        )


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
