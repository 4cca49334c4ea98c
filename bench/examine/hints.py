"""Cheap explanations of a wrong gradient, from the numbers of a check: the first one that fits names the cause."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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


class Numbers(NamedTuple):
    """The components of a wrong gradient, and what else is known of it."""

    theta: np.ndarray
    """The checked inputs ``(n,)``."""
    program: np.ndarray
    difference: np.ndarray
    is_wrong: np.ndarray
    is_whole: bool
    """Whether every input was checked on its own."""
    explained: Explanation

    @property
    def ratios(self) -> np.ndarray:
        """The program's derivatives over the differences, of the wrong components."""
        return (self.program / self.difference)[self.is_wrong]


class Hint(NamedTuple):
    """An explanation of a wrong gradient."""

    cause: str
    text: str


def _are_equal(first: np.ndarray, second: np.ndarray) -> bool:
    size = float(np.abs(second).max(initial=0.0))
    return bool(0 < size < np.inf and (np.abs(first - second) <= ALIKE * np.abs(second) + ALIKE**2 * size).all())


def _difference(numbers: Numbers) -> str:
    step = numbers.explained.difference_step
    return f"it is a difference of the cost at a step of {step}" if step else ""


def _order(numbers: Numbers) -> str:
    is_other = numbers.is_whole and numbers.is_wrong.sum() > 1
    is_other = is_other and not _are_equal(numbers.program, numbers.difference)
    is_same = is_other and _are_equal(np.sort(numbers.program), np.sort(numbers.difference))
    return "its numbers are the differences in another order" if is_same else ""


def _scale(numbers: Numbers) -> str:
    theta = numbers.theta[numbers.is_wrong]
    if np.unique(theta).size < 2:
        return ""
    if _are_equal(numbers.ratios, theta):
        return "the ratios are the inputs, as of a gradient by their logarithms"
    return "the ratios are 1 over the inputs" if _are_equal(numbers.ratios, 1.0 / theta) else ""


def _along_theta(numbers: Numbers) -> str:
    error, at = numbers.program - numbers.difference, numbers.theta
    size = float(np.linalg.norm(error) * np.linalg.norm(at))
    is_along = numbers.is_whole and np.count_nonzero(at) > 1 and size > 0
    is_along = is_along and abs(float(error @ at)) > ALONG_THETA * size
    return "the error is along theta itself, as of a normalisation that is left out" if is_along else ""


def _norm(numbers: Numbers) -> str:
    first, second = (np.linalg.norm(each) for each in (numbers.program, numbers.difference))
    is_turned = numbers.is_whole and numbers.is_wrong.sum() > 1 and bool(abs(first - second) <= ALIKE * second)
    is_turned = is_turned and bool(np.linalg.norm(numbers.program - numbers.difference) > TURNED * second)
    return "its norm is that of the differences, as in another frame" if is_turned else ""


def _ends(numbers: Numbers) -> str:
    first, *_, last = numbers.explained.growth
    errors = (f"{number(100 * one.error)}% after {counted(one.steps, 'step')}" for one in (first, last))
    return " and ".join(errors)


def _short_float(numbers: Numbers) -> str:
    noise, growth = numbers.explained.gradient_noise, numbers.explained.growth
    errors = np.abs(numbers.program - numbers.difference)[numbers.is_wrong]
    if not (noise >= SHORT and (errors <= EXPLAINED * noise * np.linalg.norm(numbers.program)).all()):
        return ""
    grown = f", and is off by {_ends(numbers)}" if len(growth) > 1 else ""
    return f"the gradient has noise of its own, {number(100 * noise, 1)}%, as by a short float{grown}"


def _falling(numbers: Numbers) -> str:
    growth = numbers.explained.growth
    errors = [one.error for one in growth]
    is_falling = len(growth) > 1 and errors[0] > FALLS * errors[-1] and errors == sorted(errors, reverse=True)
    return f"off by {_ends(numbers)}" if is_falling else ""


HINTS: Sequence[tuple[str, Callable[[Numbers], str]]] = (
    ("wrong_adjoint", _difference),
    ("wrong_adjoint", _order),
    ("wrong_adjoint", _scale),
    ("missing_term", _along_theta),
    ("wrong_adjoint", _short_float),
    ("continuous_adjoint", _falling),
    ("wrong_adjoint", _norm),
)
"""Causes and their explanations, in the order in which they are tried."""


@np.errstate(all="ignore")
def hint_of(check: Check, theta: np.ndarray, explained: Explanation) -> Hint | None:
    """Return the first explanation that fits a wrong gradient at ``theta (d,)``; None if none does, or a factor is the cause."""
    parts = check.components
    if check.cause not in EXCUSABLE or not any(part.verdict in SUSPICIOUS for part in parts):
        return None
    columns = ([theta[part.component or 0], part.program, part.difference] for part in parts)
    at, program, difference = np.array(list(columns)).T
    wrong = np.array([part.verdict in SUSPICIOUS for part in parts])
    numbers = Numbers(at, program, difference, wrong, len(parts) == theta.size, explained)
    if not np.isfinite(numbers.program).all():
        return None
    found = ((cause, explain(numbers)) for cause, explain in HINTS)
    return next((Hint(cause, text) for cause, text in found if text), None)
