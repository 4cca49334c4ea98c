"""Finds why a gradient is wrong, from the ratios of its components to the differences at several thetas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

CONSTANT = 1e-3
"""Largest relative deviation of a ratio that counts as constant, however large the ratio's error."""
MOSTLY = 0.8
"""Least share of the ratios that must agree."""
FINEST = 1e-5
"""Relative deviation of a constant ratio that the program's own rounding explains."""
KNOWN = 10.0
"""Allowed deviation of a ratio, in multiples of its own error."""
ENOUGH = 3
"""Fewest ratios that can count as constant."""


@dataclass(frozen=True)
class Ratio:
    """The program's derivative over the difference, and the ratio's error due to the error of the difference."""

    value: float
    error: float


def causes_of_ratios(
    components: dict[int, list[Ratio]], directions: list[Ratio], some_right: bool, right_elsewhere: bool = False
) -> dict[int | None, str]:
    """Return the cause of each wrong component by index, and the cause of the wrong directions under the key None.

    ``components`` are the ratios of each wrong component to its difference at several thetas, and ``directions`` the
    ratios of the wrong random directions. ``some_right`` states whether other components are right, and
    ``right_elsewhere`` whether the whole gradient is right at other thetas.

    - ``wrong_factor``: the ratio of each wrong component is the same at all thetas, within its error. A constant ratio
      beside a component with a missing term does not count, since a missing term may act on one input as a factor.
    - ``missing_term``: the ratio varies, and either other components are right, or the gradient is right at thetas
      where the term does not act, or the ratio lies between 0 and 2, so the gradient has part of the derivative.
    - ``wrong_adjoint``: neither applies, or there are too few ratios to decide.
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
    """Return whether there are enough ratios and four in five of them agree; a kink or noise may change the others.

    The ratios must agree to the accuracy of the differences, because a missing term also causes similar ratios: all
    near 1 where the term is small, and nearly equal where it hardly varies.
    """
    values, errors = np.array([ratio.value for ratio in ratios]), np.array([ratio.error for ratio in ratios])
    if len(ratios) < ENOUGH or not np.isfinite(values).all():
        return False
    middle = float(np.median(values))
    apart = FINEST * min(abs(middle), abs(middle - 1.0))
    allowed = np.clip(KNOWN * errors, apart, CONSTANT * abs(middle))
    near = np.abs(values - middle) <= allowed
    return bool(near.mean() >= MOSTLY and abs(middle) > 0.0)
