"""The colour and the marker that an estimator has in every chart, by its place among all registered ones."""

from __future__ import annotations

from bench.model import registry
from bench.report.style import colour, marker


def ink(estimator: str) -> str:
    """Return the estimator's colour."""
    return colour(_place(estimator))


def stamp(estimator: str, variant: int = 0) -> str:
    """Return the estimator's marker, another for each variant of its parameters."""
    return marker(_place(estimator), variant)


def _place(estimator: str) -> int:
    names = sorted(registry.entries()["estimators"])
    return names.index(estimator) if estimator in names else len(names)
