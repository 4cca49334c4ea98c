"""C16 and C17: pushing through a stiff contact: how much of the variance comes from the contact?"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import estimator, problem, spread, terms
from bench.model import Problem

SMOOTHED, COARSE, FINE = 20_000, 20_000, 4096
"""Samples of each variance."""
TAILS = 0.25
"""Relative error of a variance of 1,000 samples above which a few samples dominate it."""


def sampled(at: Problem, count: int, seed: int) -> list[tuple[float, float]]:
    """Return the variances of first- and zeroth-order terms, each with its standard error."""
    w = np.random.default_rng(seed).standard_normal((at.program.n_noise, count))
    return [spread(terms(at, estimator(name), w), 20) for name in ("fobg", "reinforce")]


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
        published = {
            "1e2": ("10.82", "2970"), "1.27e4": ("10.77", "2959"), "2.8e4": ("15.99", "2967"), "6.4e4": ("3.9e5", "2368")
        }  # fmt: skip
        figures: list[Figure] = []
        series: dict[str, list[Any]] = {"beta": [float(beta) for beta in published], "first": [], "zeroth": []}
        for beta, (first, zeroth) in published.items():
            at = problem("pushing[sigma=0.3]", f"softplus[stiffness=1e5,beta={float(beta)!r}]")
            one, none = sampled(at, SMOOTHED, 16)
            series["first"].append(one)
            series["zeroth"].append(none)
            figures.append(Figure(f"zeroth order, beta = {beta}", zeroth, *none, spread=source_error(none, SMOOTHED)))
            if beta == "6.4e4":
                seeds = [sampled(at, 1000, seed)[0][0] for seed in range(12)]
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
        published = {10.0: ("46", "44"), 100.0: ("7e2", "6e2"), 300.0: ("4e4", "1e4"), 1000.0: ("1e10", "2e7")}
        figures, finer_figures = [], []
        series: dict[str, list[Any]] = {"k": list(published), "coarse": [], "fine": [], "zeroth": []}
        for k, (coarse, fine) in published.items():
            at = problem(f"pushing[{values},horizon=200,dt=0.005]", f"penalty[stiffness={k!r}]")
            one, none = sampled(at, COARSE, 17)
            series["coarse"].append(one)
            series["zeroth"].append(none)
            figures.append(_heavy(f"first order, k = {k:g}", coarse, one, COARSE))
            figures.append(Figure(f"zeroth order, k = {k:g}", "1.3e7", *none, spread=source_error(none, COARSE)))
            at = problem(f"pushing[{finer}]", f"penalty[stiffness={k!r}]")
            w = np.random.default_rng(171).standard_normal((200, FINE))
            series["fine"].append(spread(terms(at, estimator("fobg"), w), 16))
            finer_figures.append(_heavy(f"first order, k = {k:g}, step 20 times finer", fine, series["fine"][-1], FINE))
        ratio = series["coarse"][-1][0] / series["fine"][-1][0]
        return Outcome(
            figures + finer_figures,
            reservation=(
                f"at k = 1000 the variance falls {ratio:.0f}-fold when the step alone is refined, so {np.log10(ratio):.1f} of "
                "its decades are the step's; both numbers there have tails that no seed settles, and are compared by a factor"
            ),
            series=series,
        )


def _heavy(what: str, text: str, values: tuple[float, float], count: int) -> Figure:
    """Return a figure that is compared by the errors of both sides, or by a factor if heavy tails dominate the error."""
    measured, error = values
    if error * math.sqrt(count / 1000) < TAILS * measured:
        return Figure(what, text, measured, error, spread=source_error(values, count))
    return Figure(what, text, measured, error, factor=10.0)
