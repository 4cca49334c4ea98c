"""Cheap explanations of a wrong gradient, from the numbers of a check: the first one that fits names the cause."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.examine.diagnosis import Explanation
from bench.gradient import Check
from bench.gradient.rules import EXCUSABLE, SUSPICIOUS
from bench.report.text import counted, number

ALIKE = 1e-3
"""Largest relative difference of numbers that count as equal."""
ALONG_THETA = 0.9999
"""Least cosine between theta and an error along theta."""
TURNED = 0.1
"""Least distance of gradients of equal norm, relative to it, that a turned frame explains."""
SHORT, EXPLAINED = 2.0**-13, 50.0
"""Least relative noise of a gradient that shows a shorter float, and the largest error in multiples of that noise."""
FALLS = 3.0
"""Least ratio of the errors after the fewest and after the most steps where an error falls."""


class Hint(NamedTuple):
    """An explanation of a wrong gradient."""

    cause: str
    text: str


@np.errstate(all="ignore")
def hint_of(check: Check, theta: np.ndarray, explained: Explanation) -> Hint | None:
    """Return the first explanation that fits a wrong gradient at ``theta (d,)``; None if none does, or a factor is the cause."""
    parts = check.components
    wrong = np.array([part.verdict in SUSPICIOUS for part in parts])
    if check.cause not in EXCUSABLE or not wrong.any():
        return None
    at, program, difference = np.array([[theta[p.component or 0], p.program, p.difference] for p in parts]).T
    if not np.isfinite(program).all():
        return None
    inputs, ratios, error = at[wrong], (program / difference)[wrong], program - difference
    step, noise, growth = explained.difference_step, explained.gradient_noise, explained.growth
    is_whole = len(parts) == theta.size
    is_several = is_whole and wrong.sum() > 1
    is_sorted = _are_equal(np.sort(program), np.sort(difference)) and not _are_equal(program, difference)
    is_log = np.unique(inputs).size > 1 and _are_equal(ratios, inputs)
    sizes = float(np.linalg.norm(error) * np.linalg.norm(at))
    is_along = np.count_nonzero(at) > 1 and sizes > 0 and abs(float(error @ at)) > ALONG_THETA * sizes
    ends = [f"{number(100 * one.error)}% after {counted(one.steps, 'step')}" for one in (*growth[:1], *growth[1:][-1:])]
    is_short = noise >= SHORT and (np.abs(error[wrong]) <= EXPLAINED * noise * np.linalg.norm(program)).all()
    grown = f", and is off by {' and '.join(ends)}" * (len(ends) > 1)
    errors = [one.error for one in growth]
    is_falling = len(growth) > 1 and errors[0] > FALLS * errors[-1] and errors == sorted(errors, reverse=True)
    size = float(np.linalg.norm(difference))
    is_turned = abs(np.linalg.norm(program) - size) <= ALIKE * size and np.linalg.norm(error) > TURNED * size
    short = f"the gradient has noise of its own, {number(100 * noise, 1)}%, as by a short float{grown}"
    rows = [
        ("wrong_adjoint", step, f"it is a difference of the cost at a step of {step}"),
        ("wrong_adjoint", is_several and is_sorted, "its numbers are the differences in another order"),
        ("wrong_adjoint", is_log, "the ratios are the inputs, as of a gradient by their logarithms"),
        (
            "missing_term",
            is_whole and is_along,
            "the error is along theta itself, as of a normalisation that is left out",
        ),
        ("wrong_adjoint", is_short, short),
        ("continuous_adjoint", is_falling, f"off by {' and '.join(ends)}"),
        ("wrong_adjoint", is_several and is_turned, "its norm is that of the differences, as in another frame"),
    ]
    return next((Hint(cause, text) for cause, holds, text in rows if holds), None)


def _are_equal(first: np.ndarray, second: np.ndarray) -> bool:
    size = float(np.abs(second).max(initial=0.0))
    return bool(0 < size < np.inf and (np.abs(first - second) <= ALIKE * np.abs(second) + ALIKE**2 * size).all())
