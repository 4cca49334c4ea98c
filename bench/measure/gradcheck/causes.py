"""Why a gradient is wrong, by the ratios of its components to the differences, at several thetas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

CONSTANT = 1e-3
"""Most that a ratio may spread and still count as constant, relative to itself, however large its error."""
MOSTLY = 0.8
"""Share of ratios that may decide for all."""
FINEST = 1e-5
"""Spread that the program's own rounding may leave a constant ratio, relative to the same."""
KNOWN = 10.0
"""Errors of a difference by which its ratio may be off."""
ENOUGH = 3
"""Ratios without which none counts as constant."""


@dataclass(frozen=True)
class Ratio:
    """A derivative of the program over its difference, and the error that the difference leaves it."""

    value: float
    error: float


def causes_of_ratios(
    components: dict[int, list[Ratio]], directions: list[Ratio], some_right: bool, right_elsewhere: bool = False
) -> dict[int | None, str]:
    """Return the cause of each wrong component, and under None that of wrong directions.

    ``components`` are the ratios of each wrong component to its difference at several thetas, ``directions`` those of
    the random directions that are wrong. ``some_right`` says whether other components are right, ``right_elsewhere``
    whether the whole gradient is at other thetas.

    - ``wrong_factor``: the ratio of each wrong component is the same at all thetas, within its error. One that is
      constant beside others that are not says nothing: a term may act alike on one input.
    - ``missing_term``: it changes, while other components are right, or the gradient is right where the term does not
      act, or while the ratio lies between 0 and 2: the gradient has part of the derivative.
    - ``wrong_adjoint``: neither, or too few ratios to say.
    """
    causes: dict[int | None, str] = {}
    some_right = some_right or right_elsewhere
    for component, ratios in components.items():
        causes[component] = _cause(ratios, some_right)
    every = [ratio for ratios in components.values() for ratio in ratios]
    if len(components) > 1 and _constant(every):
        causes = dict.fromkeys(causes, "wrong_factor")
    elif "missing_term" in causes.values():
        causes = {c: "missing_term" if cause == "wrong_factor" else cause for c, cause in causes.items()}
    if causes:
        kinds = [causes[c] for c in components]
        causes[None] = max(kinds, key=kinds.count)
    else:
        causes[None] = _cause(directions, some_right)
    return causes


def _cause(ratios: list[Ratio], some_right: bool) -> str:
    if _constant(ratios):
        return "wrong_factor"
    values = [ratio.value for ratio in ratios]
    if len(values) < ENOUGH or not np.isfinite(values).all():
        return "wrong_adjoint"
    partly = np.mean([0.0 < value < 2.0 for value in values]) >= MOSTLY
    return "missing_term" if some_right or partly else "wrong_adjoint"


def _constant(ratios: list[Ratio]) -> bool:
    """Return whether there are enough ratios and all are the same, up to one in five that a kink or noise may spoil.

    A gradient that misses a little has ratios near 1 everywhere, and one whose term hardly changes has ratios that are
    nearly the same: they have to agree as well as the differences are known.
    """
    values, errors = np.array([ratio.value for ratio in ratios]), np.array([ratio.error for ratio in ratios])
    if len(ratios) < ENOUGH or not np.isfinite(values).all():
        return False
    middle = float(np.median(values))
    apart = FINEST * min(abs(middle), abs(middle - 1.0))
    allowed = np.clip(KNOWN * errors, apart, CONSTANT * abs(middle))
    near = np.abs(values - middle) <= allowed
    return bool(near.mean() >= MOSTLY and abs(middle) > 0.0)
