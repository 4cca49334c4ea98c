"""Why a gradient is wrong, by the ratios of its components to the differences, at several thetas."""

from __future__ import annotations

import numpy as np

CONSTANT = 1e-3
"""Relative spread within which a ratio counts as constant."""
MOSTLY = 0.8
"""Share of ratios that may decide for all."""
ENOUGH = 3
"""Ratios without which none counts as constant."""


def of_ratios(components: dict[int, list[float]], directions: list[float], some_right: bool) -> dict[int | None, str]:
    """Return the cause of each wrong component, and under None that of wrong directions.

    ``components`` are the ratios of each wrong component to its difference at several thetas, ``directions`` those of
    the random directions that are wrong, and ``some_right`` says whether other components are right.

    - ``wrong_factor``: the ratio is the same at all thetas.
    - ``missing_term``: it changes, while other components are right, or while it lies between 0 and 2: the gradient has
      part of the derivative.
    - ``wrong_adjoint``: neither, or too few ratios to say.
    """
    causes: dict[int | None, str] = {}
    for component, ratios in components.items():
        causes[component] = _of(ratios, some_right)
    every = [ratio for ratios in components.values() for ratio in ratios]
    if len(components) > 1 and _constant(every):
        causes = dict.fromkeys(causes, "wrong_factor")
    if causes:
        kinds = [causes[c] for c in components]
        causes[None] = max(kinds, key=kinds.count)
    else:
        causes[None] = _of(directions, some_right)
    return causes


def _of(ratios: list[float], some_right: bool) -> str:
    if _constant(ratios):
        return "wrong_factor"
    if len(ratios) < ENOUGH or not np.isfinite(ratios).all():
        return "wrong_adjoint"
    partly = np.mean([0.0 < ratio < 2.0 for ratio in ratios]) >= MOSTLY
    return "missing_term" if some_right or partly else "wrong_adjoint"


def _constant(ratios: list[float]) -> bool:
    """Return whether there are enough ratios and all are the same, up to one in five that a kink or noise may spoil."""
    if len(ratios) < ENOUGH or not np.isfinite(ratios).all():
        return False
    middle = float(np.median(ratios))
    near = np.abs(np.array(ratios) - middle) <= CONSTANT * abs(middle)
    return bool(near.mean() >= MOSTLY and abs(middle) > 0.0)
