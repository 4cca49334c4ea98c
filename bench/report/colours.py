"""Returns the colour and marker of an estimator in every chart, by its place among all registered estimators."""

from __future__ import annotations

import re
from collections import Counter
from functools import cache

from bench.experiment.config import config_dir
from bench.model import registry
from bench.report.style import colour, marker


def estimator_colour(estimator: str) -> str:
    """Return the estimator's colour."""
    return colour(_place(estimator))


def estimator_marker(estimator: str, variant: int = 0) -> str:
    """Return the estimator's marker; ``variant`` is the number of its parameter variant, from 0."""
    return marker(_place(estimator), variant)


def estimator_order() -> list[str]:
    """Return all registered estimators, those of most of the package's experiments first.

    The first colours of the palette differ most, so they belong to the estimators that are compared most often.
    """
    uses = _uses()
    return sorted(registry.entries()["estimators"], key=lambda name: (-uses[name], name))


@cache
def _uses() -> Counter[str]:
    """Return in how many of the package's experiments each word occurs."""
    paths = sorted((config_dir() / "experiment").glob("*.yaml"))
    return Counter(word for path in paths for word in set(re.findall(r"\w+", path.read_text(encoding="utf-8"))))


def _place(estimator: str) -> int:
    names = estimator_order()
    return names.index(estimator) if estimator in names else len(names)
