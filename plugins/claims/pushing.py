"""C16 and C17: pushing through a stiff contact: how much of the variance comes from the contact?"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.claims.claim import Claim, Figure, Outcome
from bench.claims.toolkit import estimator, problem, spread, terms

if TYPE_CHECKING:
    from bench.model import Problem


SMOOTHED, COARSE, FINE = 20_000, 20_000, 4096
"""Samples of each variance."""
TAILS = 0.25
"""Relative error of a variance of 1,000 samples above which a few samples dominate it."""


def sampled(
    at: Problem, count: int, seed: int, zeroth: str = "reinforce"
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the variances of first- and zeroth-order terms, each with its standard error."""
    w = np.random.default_rng(seed).standard_normal((at.program.n_noise, count))
    first, other = (terms(at, estimator(name), w) for name in ("fobg", zeroth))
    return spread(first, 20), spread(other, 20)


def source_error(values: tuple[float, float], count: int) -> float:
    """Return two standard errors of the source's variance of 1,000 samples, scaled from ``values`` of ``count`` samples.

    The sources state each variance as one number from about a thousand samples, without an interval.
    """
    return 2 * values[1] * math.sqrt(count / 1000)


class SmoothedPush(Claim):
    """Smoothing the contact of the pushing scene."""

    name = "C16"
    lesson = "Stiffness or step size"
    statement = (
        "Sharpening a smoothed contact raises the first order's variance from 11 to 3.9e5 and more, while the zeroth order's "
        "stays near 2,900."
    )
    source = "Suh et al. 2022, ICML"
    learned = "Smooth contact until its width is that of a sample's motion: then the first order is far better."
    labels = ("sharpness beta [1/m]", "variance of one sample")
    logarithmic = "xy"
    curves = {"first": "first order", "zeroth": "zeroth order"}
    quick = False

    def measure(self) -> Outcome:
        """Sample both orders at the published sharpnesses."""
        first = {"1e2": "10.82", "1.27e4": "10.77", "2.8e4": "15.99", "6.4e4": "3.9e5"}
        zeroth = {"1e2": "2970", "1.27e4": "2959", "2.8e4": "2967", "6.4e4": "2368"}
        figures: list[Figure] = []
        series: dict[str, list[Any]] = {"beta": [], "first": [], "zeroth": []}
        seeds = []
        for beta in first:
            at = problem("pushing[sigma=0.3]", f"softplus[stiffness=1e5,beta={float(beta)!r}]")
            (v1, e1), (v0, e0) = sampled(at, SMOOTHED, 16)
            once = source_error((v1, e1), SMOOTHED), source_error((v0, e0), SMOOTHED)
            series["beta"].append(float(beta))
            series["first"].append((v1, e1))
            series["zeroth"].append((v0, e0))
            figures.append(Figure(f"zeroth order, beta = {beta}", zeroth[beta], v0, e0, spread=once[1]))
            if beta == "6.4e4":
                seeds = [sampled(at, 1000, seed)[0][0] for seed in range(12)]
                figures.append(
                    Figure(
                        "first order, beta = 6.4e4, median of 12 seeds of 1,000",
                        first[beta],
                        float(np.median(seeds)),
                        factor=30.0,
                    )
                )
            else:
                figures.append(Figure(f"first order, beta = {beta}", first[beta], v1, e1, spread=once[0]))
        low, high = min(seeds), max(seeds)
        return Outcome(
            figures,
            reservation=(
                f"at the hard end the first order's variance is that of a few samples: between {low:.1e} and {high:.1e} over "
                "12 seeds of 1,000; and h^2 2 k / m = 50 there, beyond the step's stability limit of 3.2"
            ),
            series=series,
        )


class StiffPush(Claim):
    """Pushing at several stiffnesses and two steps."""

    name = "C17"
    lesson = "Stiffness or step size"
    statement = (
        "Over 200 steps the first order's variance grows from 46 at k = 10 to 1e10 at k = 1000, while the zeroth order's "
        "stays at 1.3e7."
    )
    source = "Suh et al. 2022, ICML; recomputed with a finer step"
    learned = "Two to three of the decades at k = 1000 are the step's, not the contact's: refine before you smooth."
    labels = ("stiffness [N/m]", "variance of one sample")
    logarithmic = "xy"
    curves = {
        "coarse": "first order, step 5 ms",
        "fine": "first order, step 0.25 ms",
        "zeroth": "zeroth order",
    }
    quick = False

    def measure(self) -> Outcome:
        """Sample with the published step, then with a step 20 times finer, each control held over 20 steps."""
        values = "velocity_factor=0.998,push=0.1,sigma=0.1"
        finer = f"velocity_factor={0.998 ** (1 / 20)!r},push=0.1,sigma=0.1,horizon=4000,hold=20,dt=0.00025"
        coarse = {10.0: "46", 100.0: "7e2", 300.0: "4e4", 1000.0: "1e10"}
        fine = {10.0: "44", 100.0: "6e2", 300.0: "1e4", 1000.0: "2e7"}
        figures: list[Figure] = []
        series: dict[str, list[Any]] = {"k": list(coarse), "coarse": [], "fine": [], "zeroth": []}
        for k, text in coarse.items():
            at = problem(f"pushing[{values},horizon=200,dt=0.005]", f"penalty[stiffness={k!r}]")
            (v1, e1), (v0, e0) = sampled(at, COARSE, 17)
            series["coarse"].append((v1, e1))
            series["zeroth"].append((v0, e0))
            figures.append(_heavy(f"first order, k = {k:g}", text, v1, e1, COARSE))
            once = source_error((v0, e0), COARSE)
            figures.append(Figure(f"zeroth order, k = {k:g}", "1.3e7", v0, e0, spread=once))
        for k, text in fine.items():
            at = problem(f"pushing[{finer}]", f"penalty[stiffness={k!r}]")
            w = np.random.default_rng(171).standard_normal((200, FINE))
            v1, e1 = spread(terms(at, estimator("fobg"), w), 16)
            series["fine"].append((v1, e1))
            figures.append(_heavy(f"first order, k = {k:g}, step 20 times finer", text, v1, e1, FINE))
        ratio = series["coarse"][-1][0] / series["fine"][-1][0]
        return Outcome(
            figures,
            reservation=(
                f"at k = 1000 the variance falls {ratio:.0f}-fold when the step alone is refined, so {np.log10(ratio):.1f} of "
                "its decades are the step's; both numbers there have tails that no seed settles, and are compared by a factor"
            ),
            series=series,
        )


def _heavy(what: str, text: str, measured: float, error: float, count: int) -> Figure:
    """Return a figure that is compared by the errors of both sides, or by a factor if heavy tails dominate the error."""
    if error * math.sqrt(count / 1000) < TAILS * measured:
        return Figure(what, text, measured, error, spread=source_error((measured, error), count))
    return Figure(what, text, measured, error, factor=10.0)
