"""The points at which a gradient check evaluates the cost, in one batch, and the samples computed from the values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

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


def sampled(
    cost: Function,
    theta: np.ndarray,
    vectors: np.ndarray,
    lengths: np.ndarray,
    derivatives: np.ndarray,
    unit: float,
    eps: np.ndarray = EPS,
    modes: Modes | None = None,
    twice: bool = False,
    doubts: np.ndarray | None = None,
    moved: np.ndarray | None = None,
) -> tuple[list[Sample], np.ndarray, np.ndarray]:
    """Return a sample per column of ``vectors (d, M)``, and the contact modes on the minus and plus sides, ``(M, K)`` each.

    ``theta`` is ``(d,)``, or ``(d, M)`` for directions that start at different points. Each is displaced along its
    vector by the steps ``eps`` to both sides, by 0, and by the offsets of the noise estimate.
    A displacement of 1 along direction m has the length ``lengths[m]``, in the unit by which ``derivatives[m]`` is
    taken. With ``twice``, costs are computed again in reverse order, which exposes columns that depend on their neighbours.
    """
    count, start = eps.size, theta.reshape(len(theta), -1, 1)
    moves = np.concatenate([-eps, eps, [0.0], offsets(unit).ravel()])
    at = (start + vectors[:, :, None] * moves).reshape(len(theta), -1)
    values = cost(at).reshape(lengths.size, -1)
    again = cost(at[:, ::-1])[::-1].reshape(values.shape) if twice else values
    repeatable = np.all(repeats(values, again, unit), axis=1)
    sides = at.reshape(len(at), lengths.size, -1)[:, :, : 2 * count].reshape(len(at), -1)
    names = np.array([""] * sides.shape[1] if modes is None else modes(sides), dtype=object).reshape(lengths.size, -1)
    minus_modes, plus_modes = names[:, :count], names[:, count:]
    result = []
    for m, row in enumerate(values):
        with np.errstate(over="ignore", invalid="ignore"):
            measured = noise(row[2 * count + 1 :].reshape(2, POINTS))
            sample = Sample(
                eps * lengths[m],
                row[:count],
                float(row[2 * count]),
                row[count : 2 * count],
                float(derivatives[m]),
                minus_modes[m] != plus_modes[m],
                bool(repeatable[m]),
                float(lengths[m]),
                unit,
                measured,
                0.0 if doubts is None else float(doubts[m]),
                0.0 if moved is None else float(moved[m]),
            )
            result.append(replace(sample, noise=max(measured, scatter(sample.step, sample.differences))))
    return result, minus_modes, plus_modes
