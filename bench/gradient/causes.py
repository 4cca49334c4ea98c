"""Finds why a gradient is wrong, from the ratios of its components to the differences at several thetas."""

from __future__ import annotations

from typing import NamedTuple

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


class Ratio(NamedTuple):
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
    some_right = some_right or right_elsewhere
    causes: dict[int | None, str] = {c: _cause(ratios, some_right) for c, ratios in components.items()}
    every = [ratio for ratios in components.values() for ratio in ratios]
    if len(components) > 1 and _cause(every, some_right) == "wrong_factor":
        causes = dict.fromkeys(causes, "wrong_factor")
    elif "missing_term" in causes.values():
        causes = {c: "missing_term" if cause == "wrong_factor" else cause for c, cause in causes.items()}
    kinds = list(causes.values())
    causes[None] = max(kinds, key=kinds.count) if kinds else _cause(directions, some_right)
    return causes


def _cause(ratios: list[Ratio], some_right: bool) -> str:
    """Return the cause that ratios show: a constant factor if four in five agree; a kink or noise may change the others.

    Constant ratios agree to the accuracy of the differences, because a missing term also causes similar ratios: all near 1
    where the term is small, and nearly equal where it hardly varies.
    """
    values, errors = np.reshape(ratios, (-1, 2)).T
    if len(ratios) < ENOUGH or not np.isfinite(values).all():
        return "wrong_adjoint"
    middle = float(np.median(values))
    apart = FINEST * min(abs(middle), abs(middle - 1.0))
    allowed = np.clip(KNOWN * errors, apart, CONSTANT * abs(middle))
    if (np.abs(values - middle) <= allowed).mean() >= MOSTLY and middle != 0.0:
        return "wrong_factor"
    partly = np.mean((values > 0.0) & (values < 2.0)) >= MOSTLY
    return "missing_term" if some_right or partly else "wrong_adjoint"
