"""C10: descent on a throw against ground and wall. The contact law decides whether the target is reached."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bench.claims import Claim, Figure, Outcome
from bench.claims.toolkit import exact_descent, native

SINGLE = 2 * 2.0**-24 * math.sqrt(288)
"""Relative rounding error of position and velocity over 288 steps in single precision, as in the published ends."""
LABELS = {"with": "with time of impact", "without": "without", "penalty": "penalty"}


class Throw(Claim):
    """A thrown ball."""

    name = "C10"
    lesson = "Time of impact"
    statement = (
        "1,000 steps of descent on a throw end at a loss of 7.8e-5 with the time of impact, .00425 without, 7e-12 with a "
        "penalty."
    )
    source = "Zhong, Han, Brikis 2022, arXiv 2207.05060, task 2"
    learned = (
        "A wrong gradient can still find a way, another one and a worse one; the forward law decides what is reachable."
    )
    labels = ("iteration", "squared distance to the target [m^2]")
    logarithmic = "y"
    curves = LABELS
    quick = False

    def measure(self) -> Outcome:
        """Descend under three laws."""
        cases = (
            ("with", "impulse", "7.8e-5", ("10.184146", "-4.160555")),
            ("without", "impulse[time_of_impact=false]", "0.00425", ("-2.493337", "-4.298402")),
            ("penalty", "penalty", "7e-12", ("10.638576", "-4.282096")),
        )
        figures: list[Figure] = []
        series: dict[str, Any] = {"iteration": list(range(0, 1001, 20))}
        for name, law, loss, ends in cases:
            end, values = exact_descent(native("ground_wall", law), np.array([5.0, -5.0]), 0.01, 1000, 20)
            figures.append(Figure(f"loss at the end, {name}", loss, float(values[-1])))
            for part, text, x in zip(("vx", "vy"), ends, end, strict=True):
                figures.append(
                    Figure(f"{part} at the end, {name}", text, float(x), spread=SINGLE * float(np.abs(end).max()))
                )
            series[name] = values
        return Outcome(figures, series=series)
