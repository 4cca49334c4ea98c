"""Judges times by the spread between runs, never by the spread within one run.

The calls of one run share its load, clock and memory layout, so their spread does not predict the next run. With further
runs of *before* (``again=DIR,DIR``), K in all, the logarithms of a cell's times have a mean, and a variance that is pooled
over all cells. A time changed if it leaves the prediction interval of one more run: the central 1 - 2 ALPHA of Student's t
with K - 1 degrees of freedom, not more, since the cells of one run are not independent. It must also change by at least
EFFECT. Two runs alone cannot show whether the machine or the code changed.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from bench.compare.judging import Change, Row, value
from bench.report.text import duration

EFFECT = 1.5
"""Smallest ratio at which a time counts as changed."""
LEAST_SPREAD = 0.05
"""Lower bound of the assumed standard deviation of a logarithmic time between runs."""
ALPHA = 1e-3
"""Significance level on each side."""
RUNS = 3
"""Smallest number of runs of before, the first included, from which a spread is computed."""
NOTE = (
    f"With again=, a time counts if it changed by a factor of {EFFECT:g} or more and by more than the spread between runs of "
    f"before (p < {2 * ALPHA:g} in Student's t)."
)

Runs = Mapping[Hashable, Row]


def judge_times(
    name: str, called: str, before: Runs, after: Runs, again: Sequence[Runs]
) -> tuple[dict[Hashable, Change], list[str]]:
    """Return the changes of the time column ``name`` by cell, and remarks.

    ``before``, ``after`` and each further run of before in ``again`` are rows by cell. ``called`` is the column's name in
    messages.
    """
    from scipy.special import stdtrit

    keys = [key for key in before if key in after and value(before[key], name) > 0 and value(after[key], name) > 0]
    if not keys:
        return {}, []
    runs = np.log([[value(run.get(key, {}), name) for run in (before, *again)] for key in keys])
    complete = np.isfinite(runs).all(axis=1)
    if not complete.any():
        return {}, ["no cell is in all runs of before, so times are not judged"]
    n_unjudged = int((~complete).sum())
    remark = f"times of {n_unjudged} cells are not judged, since some run of before lacks the cell"
    count = runs.shape[1]
    spread = max(LEAST_SPREAD, float(np.sqrt(runs[complete].var(axis=1, ddof=1).mean())))
    limit = max(math.log(EFFECT), float(stdtrit(count - 1, 1 - ALPHA)) * spread * math.sqrt(1 + 1 / count))
    changes = {}
    for key, usual in zip(keys, runs.mean(axis=1), strict=True):
        new = value(after[key], name)
        growth = math.log(new) - usual
        if abs(growth) > limit:  # never for a missing time
            text = f"{called} {duration(math.exp(usual))} to {duration(new)} ({math.exp(growth):.2g} times)"
            changes[key] = Change("worse" if growth > 0 else "better", text, called)
    return changes, [remark] * bool(n_unjudged)
