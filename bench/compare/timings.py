"""Judges times by the spread between runs, never by the spread within one run.

The calls of one run share its load, clock and memory layout, so their spread does not predict the next run. With further
runs of *before* (``again=DIR,DIR``), K in all, the logarithms of a cell's times have a mean, and a variance that is pooled
over all cells. A time changed if it leaves the prediction interval of one more run: the central 1 - 2 ALPHA of Student's t
with K - 1 degrees of freedom, not more, since the cells of one run are not independent. It must also change by at least
TIME_EFFECT. Two runs alone cannot show whether the machine or the code changed.
"""

from __future__ import annotations

import math
from collections.abc import Hashable

import numpy as np
import pandas as pd

from bench.compare.judging import Change
from bench.report.text import duration

TIME_EFFECT = 1.5
"""Smallest ratio at which a time counts as changed."""
ALPHA = 1e-3
"""Significance level on each side."""
RUNS = 3
"""Smallest number of runs of before, the first included, from which a spread is computed."""
NOTE = (
    f"With again=, a time counts if it changed by a factor of {TIME_EFFECT:g} or more and by more than the spread between runs of "
    f"before (p < {2 * ALPHA:g} in Student's t)."
)


def judge_times(
    called: str, before: pd.Series, after: pd.Series, *again: pd.Series
) -> tuple[dict[Hashable, Change], list[str]]:
    """Return the changes of a time by cell, and remarks.

    ``before``, ``after`` and each further run of before in ``again`` are times by cell. ``called`` is the time's name in messages.
    """
    from scipy.special import stdtrit

    runs = np.log(
        pd.concat([after, before, *again], axis=1, join="outer")
        .astype(float)
        .pipe(lambda times: times.where(times > 0))
    )
    runs = runs[runs.iloc[:, :2].notna().all(axis=1)]
    new, runs = runs.iloc[:, 0], runs.iloc[:, 1:]
    if runs.empty:
        return {}, []
    complete = runs.dropna()
    if complete.empty:
        return {}, ["no cell is in all runs of before, so times are not judged"]
    n_unjudged, count = len(runs) - len(complete), runs.shape[1]
    remark = f"times of {n_unjudged} cells are not judged, since some run of before lacks the cell"
    # the standard deviation of a logarithmic time between runs, at least 5%
    spread = max(0.05, float(np.sqrt(complete.var(axis=1, ddof=1).mean())))
    limit = max(math.log(TIME_EFFECT), float(stdtrit(count - 1, 1 - ALPHA)) * spread * math.sqrt(1 + 1 / count))
    growth = new[complete.index] - complete.mean(axis=1)
    changes = {
        key: Change(
            "worse" if grown > 0 else "better",
            f"{called} {duration(math.exp(new[key] - grown))} to {duration(math.exp(new[key]))} ({math.exp(grown):.2g} times)",
            called,
        )
        for key, grown in growth[growth.abs() > limit].items()
    }
    return changes, [remark] * bool(n_unjudged)
