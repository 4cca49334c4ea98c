"""C2: a steep ramp: unbiased and useless."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import bisect
from scipy.special import ndtr

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import centre, estimator, moments, problem

SIGMA, NU = 0.1, 0.005


class Ramp(Claim):
    """A ramp of width nu from -1 to 1, noise 0.1."""

    name = "C2"
    lesson = "Low variance is not low bias"
    statement = (
        "On a ramp of width nu the first-order gradient is unbiased, and beats the zeroth order only above nu = 1.5 sigma; "
        "on a steep ramp 100 samples often all miss it."
    )
    source = "Suh et al. 2022, ICML"
    learned = "An unbiased gradient can be useless: in finite samples a steep ramp is a jump."
    quantity = "variance of one sample"
    logarithmic = "xy"
    marks = (("x", 1.517, "published crossing"),)
    quick = False

    def measure(self) -> Outcome:
        """Compute the width at which the variances are equal, and the errors of small batches."""
        first, zeroth = estimator("fobg"), estimator("reinforce[baseline=center]")

        def gap(nu: float) -> float:
            at = problem(f"soft_heaviside[nu={nu!r},sigma={SIGMA}]")
            return float(np.log(moments(at, first)[1][0] / moments(at, zeroth)[1][0]))

        crossing = bisect(gap, 0.1, 0.2, xtol=6e-6)
        at = problem(f"soft_heaviside[nu={NU},sigma={SIGMA}]")
        draw = np.random.default_rng(2)
        batches = 40_000
        # in parts, to limit memory
        parts = [at.grad(np.zeros(1), draw.standard_normal((1, 100 * batches))) == 0 for _ in range(5)]
        missed = np.concatenate([part.reshape(batches, 100).all(axis=1) for part in parts])
        figures = [
            Figure("crossing of the variances, in sigma", "1.517", crossing / SIGMA, 6e-5),
            Figure("chance that 100 samples all have gradient 0", "0.1334", *centre(missed.astype(float))),
        ]
        for count, *expected in ((1, "2.05", "1.49"), (100, "0.754", "0.210"), (1000, "0.251", "0.068")):
            figures += _errors(at, draw, count, expected)
        widths = np.geomspace(0.02, 4, 15) * SIGMA
        problems = [problem(f"soft_heaviside[nu={float(nu)!r},sigma={SIGMA}]") for nu in widths]
        curves = {
            name: [moments(one, order, count=40_000)[1][0] for one in problems]
            for name, order in (("first order", first), ("zeroth order", zeroth))
        }
        return Outcome(figures, series={"width of the ramp / sigma": widths / SIGMA} | curves)


def _errors(at: Any, draw: np.random.Generator, count: int, expected: list[str]) -> list[Figure]:
    """Return mean absolute errors over 1,000 random theta in [-1, 1]. The source drew them once, which is its spread."""
    theta = np.linspace(-1, 1, 1000)
    truth = (ndtr((NU / 2 - theta) / SIGMA) - ndtr((-NU / 2 - theta) / SIGMA)) * 2 / NU
    base = at.value(theta[None], np.zeros((1, 1000)))[:, None]
    every = np.repeat(theta, count)[None]
    errors = []
    for _ in range(max(4, 4000 // count)):
        w = draw.standard_normal((1, 1000 * count))
        cost = at.value(every, w).reshape(1000, count) - base
        means = at.grad(every, w).reshape(1000, count), cost * w.reshape(1000, count) / SIGMA
        errors.append([np.abs(mean.mean(axis=1) - truth).mean() for mean in means])
    return [
        Figure(
            f"{name}-order mean absolute error, {count} samples",
            text,
            *centre(values),
            2 * float(np.std(values, ddof=1)),
        )
        for name, text, values in zip(("first", "zeroth"), expected, np.transpose(errors), strict=True)
    ]
