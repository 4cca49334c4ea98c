"""Finds spikes of a gradient measure, and tests whether they are near contact switches more often than by chance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

MEASURES = {"jacobian_norm": "|dF/dx|", "adjoint_norm": "|dL/dx|"}
"""Columns whose spikes are compared with the contact switches, and how they are printed."""
LEVEL = 0.05
"""Largest p-value at which spikes count as aligned with switches."""


class Alignment(NamedTuple):
    """The number of spikes within one step of a contact switch, compared with chance."""

    spikes: int
    near: int
    chance: float
    """Share of all steps that are within one step of a switch: the share of spikes expected there by chance."""
    p_value: float
    """p-value of a permutation test: the probability that at least as many spikes at random steps are near a switch."""


def changes(values: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return |log ratio| of neighbouring ``values (T + 1,)``, ``(T,)``; 0 where a value is zero or not finite."""
    with np.errstate(all="ignore"):
        steps = np.abs(np.diff(np.log(np.asarray(values, dtype=np.float64))))
    return np.where(np.isfinite(steps), steps, 0.0)


def spikes(values: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the steps that are spikes, boolean ``(T,)``: changes by a factor above 3 and among the largest tenth.

    In a run of neighbouring steps of this kind only the largest counts: a rise over several steps is one spike.
    """
    steps = changes(values)
    largest = np.sort(steps)[-max(1, int(0.1 * len(steps)))]
    high = (steps > np.log(3.0)) & (steps >= largest)  # one stage cost may double a norm
    result = np.zeros(len(steps), dtype=bool)
    for run in np.split(np.arange(len(steps)), np.flatnonzero(np.diff(high.astype(int))) + 1):
        if high[run[0]]:
            result[run[np.argmax(steps[run])]] = True
    return result


def align(values: Sequence[float] | np.ndarray, switch: Sequence[int] | np.ndarray) -> Alignment:
    """Return how spikes of ``values (T + 1,)`` align with ``switch (T + 1,)``, 1 where contacts have just changed."""
    from scipy.stats import hypergeom

    spiked = spikes(values)
    switched = np.asarray(switch[1:], dtype=bool)
    near = switched.copy()
    near[1:] |= switched[:-1]
    near[:-1] |= switched[1:]
    hits, steps, covered, drawn = (int(n) for n in ((spiked & near).sum(), len(near), near.sum(), spiked.sum()))
    p_value = float(hypergeom.sf(hits - 1, steps, covered, drawn))
    return Alignment(drawn, hits, covered / steps, p_value)
