"""C16 and C17: pushing through a stiff contact: how much of the variance comes from the contact?"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import estimator, problem, spread, terms
from bench.model import Problem

SMOOTHED, COARSE, FINE = 20_000, 20_000, 4096
"""Samples of each variance."""
CURVES = ("first order, step 5 ms", "step 0.25 ms, first order", "zeroth order")


def sampled(at: Problem, count: int, seed: int, batches: int = 20) -> Iterator[tuple[float, float]]:
    """Yield the variances of first- and zeroth-order terms, each with its standard error."""
    w = np.random.default_rng(seed).standard_normal((at.program.n_noise, count))
    return (spread(terms(at, estimator(name), w), batches) for name in ("fobg", "reinforce[baseline=center]"))


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
    learned = (
        "The first order of a smoothed contact has far less variance than the zeroth, until the contact is too sharp."
    )
    quantity = "variance of one sample"
    logarithmic = "xy"
    quick = False

    def measure(self) -> Outcome:
        """Sample both orders at the published sharpnesses."""
        published = {
            "1e2": ("10.82", "2970"),
            "1.27e4": ("10.77", "2959"),
            "2.8e4": ("15.99", "2967"),
            "6.4e4": ("3.9e5", "2368"),
        }
        figures: list[Figure] = []
        variances = []
        for beta, (first, zeroth) in published.items():
            at = problem("pushing[sigma=0.3]", f"softplus[stiffness=1e5,beta={float(beta)!r}]")
            one, none = sampled(at, SMOOTHED, 16)
            variances.append((one, none))
            figures.append(Figure(f"zeroth order, beta = {beta}", zeroth, *none, spread=source_error(none, SMOOTHED)))
            if beta == "6.4e4":
                seeds = [next(sampled(at, 1000, seed))[0] for seed in range(12)]
                what = f"first order, beta = {beta}, median of 12 seeds of 1,000"
                figures.append(Figure(what, first, float(np.median(seeds)), factor=30.0))
            else:
                figures.append(Figure(f"first order, beta = {beta}", first, *one, spread=source_error(one, SMOOTHED)))
        low, high = min(seeds), max(seeds)
        return Outcome(
            figures,
            reservation=(
                f"at the hard end the first order's variance is that of a few samples: between {low:.1e} and {high:.1e} over "
                "12 seeds of 1,000; and h^2 2 k / m = 50 there, beyond the step's stability limit of 3.2"
            ),
            series=_by_order("sharpness beta, 1 / width [1/m]", published, ("first order", "zeroth order"), variances),
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
    origin = "recomputed"
    learned = "Three decades of the first order's variance at k = 1000 are the step's, not the contact's: refine before you smooth."
    quantity = "variance of one sample"
    logarithmic = "xy"
    quick = False

    def measure(self) -> Outcome:
        """Sample with the published step, then with a step 20 times finer, each control held over 20 steps."""
        values = "velocity_factor=0.998,push=0.1,sigma=0.1"
        fine_values = f"velocity_factor={0.998 ** (1 / 20)!r},push=0.1,sigma=0.1,horizon=4000,hold=20,dt=0.00025"
        published = {10.0: ("46", "44"), 100.0: ("7e2", "6e2"), 300.0: ("4e4", "1e4"), 1000.0: ("1e10", "2e7")}
        figures, finer_figures, variances = [], [], []
        for k, (coarse, fine) in published.items():
            at = problem(f"pushing[{values},horizon=200,dt=0.005]", f"penalty[stiffness={k!r}]")
            one, none = sampled(at, COARSE, 17)
            figures.append(_heavy(f"first order, k = {k:g}", coarse, one, COARSE))
            figures.append(Figure(f"zeroth order, k = {k:g}", "1.3e7", *none, spread=source_error(none, COARSE)))
            at = problem(f"pushing[{fine_values}]", f"penalty[stiffness={k!r}]")
            finer = next(sampled(at, FINE, 171, 16))
            finer_figures.append(_heavy(f"first order, k = {k:g}, step 20 times finer", fine, finer, FINE))
            variances.append((one, finer, none))
        ratio = one[0] / finer[0]
        return Outcome(
            figures + finer_figures,
            reservation=(
                f"at k = 1000 the variance falls {ratio:.0f}-fold when the step alone is refined, so {np.log10(ratio):.1f} of "
                "its decades are the step's; both numbers there have tails that no seed settles, and are compared by a factor"
            ),
            series=_by_order("stiffness [N/m]", published, CURVES, variances),
        )


def _by_order(name: str, places: Iterable[Any], curves: Sequence[str], variances: Sequence[Any]) -> dict[str, Any]:
    """Return the series of a chart from the variances of all curves at each place."""
    return {name: list(map(float, places)), **dict(zip(curves, zip(*variances, strict=True), strict=True))}


def _heavy(what: str, text: str, values: tuple[float, float], count: int) -> Figure:
    """Return a figure that is compared by the errors of both sides, or by a factor if heavy tails dominate the error."""
    measured, error = values
    # above this relative error of the variance of 1,000 samples, a few of them dominate it
    if error * math.sqrt(count / 1000) < 0.25 * measured:
        return Figure(what, text, measured, error, spread=source_error(values, count))
    return Figure(what, text, measured, error, factor=10.0)
