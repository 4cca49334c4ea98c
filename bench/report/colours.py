"""Returns the colour and marker of an estimator in every chart, by its position among all registered estimators."""

from __future__ import annotations

from bench.model import registry
from bench.report.style import colour, marker


def estimator_colour(estimator: str) -> str:
    """Return the estimator's colour."""
    return colour(_place(estimator))


def estimator_marker(estimator: str, variant: int = 0) -> str:
    """Return the estimator's marker; ``variant`` is the number of its parameter variant, from 0."""
    return marker(_place(estimator), variant)


def _place(estimator: str) -> int:
    names = sorted(registry.entries()["estimators"])
    return names.index(estimator) if estimator in names else len(names)
