"""How the normal numbers of one estimate are drawn: independently, along orthogonal directions, or as a Sobol set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

POINTS = ("iid", "orthogonal", "sobol")
"""The ways to choose the draws of an estimate. Each single draw is standard normal."""
MOST_COORDINATES = 21201
"""Largest dimension of SciPy's Sobol sequence."""
LEAST_UNITS = 4
"""Fewest units of an estimate from which a variance, a quantile or a baseline is computed."""
UNITS = 8
"""Number of units into which the draws of such an estimate are divided, if they need not be larger."""


@dataclass(frozen=True)
class Design:
    """The draws of one estimate: ``block`` draws are chosen together, and each may be followed by its mirror image.

    Blocks are independent of each other. The design concerns the first ``width`` numbers of a sample. Its last ``held``
    numbers are the scene's own noise, which is drawn independently and is the same in both draws of a pair.
    """

    draws: str = "iid"
    mirrored: bool = False
    width: int = 0
    held: int = 0
    block: int = 1

    @property
    def unit(self) -> int:
        """The number of consecutive samples that are drawn together. Different units are independent."""
        return self.block * (2 if self.mirrored else 1)


IID = Design()


def block_of(draws: str, width: int, count: int, in_units: bool) -> int:
    """Return the number of draws, of ``count``, that are chosen together; with ``in_units`` at least :data:`UNITS` blocks."""
    if draws == "iid":
        return 1
    most = count // UNITS if in_units else count
    if draws == "sobol":
        return most
    most = min(width, most)
    # blocks of equal size, where an estimator compares them
    return max((size for size in range(1, most + 1) if count % size == 0), default=1) if in_units else most


def per_unit(values: np.ndarray, unit: int) -> np.ndarray:
    """Return the means of ``values (R, N, d)`` over each unit of samples, ``(R, N / unit, d)``."""
    if unit == 1:
        return values
    return values.reshape(len(values), -1, unit, values.shape[2]).mean(axis=2)


def sums_of_units(values: np.ndarray, unit: int) -> np.ndarray:
    """Return, for each of ``values (R, N, ...)``, the sum over its unit, in the same shape."""
    if unit == 1:
        return values
    sums = values.reshape(len(values), -1, unit, *values.shape[2:]).sum(axis=2)
    return np.repeat(sums, unit, axis=1)
