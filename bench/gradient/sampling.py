"""The points at which a gradient check evaluates the cost, in one batch, and the samples computed from the values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .direction import EPS, Function, Sample
from .roughness import POINTS, noise, offsets, scatter

Modes = Callable[[np.ndarray], Sequence[str]]
"""Names of the contact modes of columns: ``(d, B)`` to ``B`` strings."""
LAST_DIGITS = 8
"""Rounding units by which the results of two equal calls may differ: threads add up in any order."""


def repeats(first: np.ndarray, second: np.ndarray, unit: float) -> np.ndarray:
    """Return where two calls return the same numbers up to rounding of the largest number of a row, ``(M, S)`` each."""
    with np.errstate(invalid="ignore"):
        size = np.abs(np.where(np.isfinite(first), first, 0.0)).max(axis=-1, keepdims=True, initial=0.0)
        is_close = np.abs(first - second) <= LAST_DIGITS * unit * size
    return (first == second) | (np.isnan(first) & np.isnan(second)) | is_close


@dataclass(frozen=True)
class Lines:
    """M lines through points along vectors, and the program's derivatives along them; a number holds for every line."""

    theta: np.ndarray
    """The points ``(d, M)``, or one ``(d,)`` for every line."""
    vectors: np.ndarray
    """The displacement by 1 along each line, ``(d, M)``."""
    derivatives: np.ndarray
    lengths: np.ndarray | float = 1.0
    """The lengths of the vectors, in the unit by which the derivatives are taken."""
    doubts: np.ndarray | float = 0.0
    """The rounding errors of the derivatives."""
    moved: np.ndarray | float = 0.0
    """The changes of the derivatives where theta changes in its last digits."""


def sampled(
    cost: Function,
    lines: Lines,
    unit: float,
    eps: np.ndarray = EPS,
    modes: Modes | None = None,
    twice: bool = False,
) -> tuple[list[Sample], np.ndarray, np.ndarray]:
    """Return a sample per line, and the contact modes on the minus and plus sides, ``(M, K)`` each.

    Each point is displaced along its vector by the steps ``eps`` to both sides, by 0, and by the offsets of the noise estimate.
    With ``twice``, costs are computed again in reverse order, which exposes columns that depend on their neighbours.
    """
    count, (size, n_lines) = eps.size, lines.vectors.shape
    moves = np.concatenate([-eps, eps, [0.0], offsets(unit).ravel()])
    at = (lines.theta.reshape(size, -1, 1) + lines.vectors[:, :, None] * moves).reshape(size, -1)
    values = cost(at).reshape(n_lines, -1)
    again = cost(at[:, ::-1])[::-1].reshape(values.shape) if twice else values
    repeatable = np.all(repeats(values, again, unit), axis=1)
    sides = at.reshape(size, n_lines, -1)[:, :, : 2 * count].reshape(size, -1)
    names = np.array([""] * sides.shape[1] if modes is None else modes(sides), dtype=object).reshape(n_lines, -1)
    minus_modes, plus_modes = np.split(names, 2, axis=1)
    numbers = np.broadcast_arrays(lines.derivatives, lines.lengths, lines.doubts, lines.moved)
    result = []
    for row, crossing, is_repeatable, *each in zip(
        values, minus_modes != plus_modes, repeatable, *numbers, strict=True
    ):
        derivative, length, doubt, moved = map(float, each)
        with np.errstate(over="ignore", invalid="ignore"):
            measured = noise(row[2 * count + 1 :].reshape(2, POINTS))
            sample = Sample(
                step=eps * length,
                minus=row[:count],
                centre=float(row[2 * count]),
                plus=row[count : 2 * count],
                derivative=derivative,
                crossing=crossing,
                repeatable=bool(is_repeatable),
                scale=length,
                unit=unit,
                noise=measured,
                doubt=doubt,
                moved=moved,
            )
            result.append(replace(sample, noise=max(measured, scatter(sample.step, sample.differences))))
    return result, minus_modes, plus_modes
