"""Bias, variance and cost of estimators against the certified gradient: the main study."""

from __future__ import annotations

from dataclasses import dataclass

from bench.model import param

from .. import StudyPackage
from .columns import COLUMNS


@dataclass(frozen=True)
class BiasVariance(StudyPackage):
    """Measures bias and variance of estimates against the reference gradient, and the cost of an estimate."""

    name = "bias_variance"
    columns = COLUMNS
    timed = True

    timed_calls: int = param(
        5,
        "estimates timed one by one on backends that do not compile; the other repeats are evaluated together",
        positive=True,
    )
    settle_s: float = param(
        0.02,
        "time within which calls are repeated until their interquartile range is below 10% of the median",
        "s",
        low=0.0,
    )
