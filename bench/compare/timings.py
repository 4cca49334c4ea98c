"""Judges times by the spread between runs, never by the spread within one run.

The calls of one run share its load, clock and memory layout, so their spread does not predict the next run. Two rules:

- With further runs of *before* (``again=DIR,DIR``), K in all: the logarithms of a cell's times have a mean, and a variance
  that is pooled over all cells. A time changed if it leaves the prediction interval of one more run: the central
  1 - 2 ALPHA of Student's t with K - 1 degrees of freedom, not more, since the cells of one run are not independent.
- Without further runs, each cell is compared with all others of its backend. The median of their logarithmic ratios is
  the change of the whole run. Two runs cannot attribute it to the machine or the code, so it is a remark. A time changed
  if it is FAR robust standard deviations from that median.

In both cases the time must also change by at least EFFECT.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from bench.compare.judging import Change, Row, value
from bench.report.text import duration

EFFECT = 1.5
"""Smallest ratio at which a time counts as changed."""
FAR = 6.0
"""Distance from the median ratio of the backend's cells, in robust standard deviations, above which a cell differs."""
LEAST_SPREAD = 0.05
"""Lower bound of the assumed standard deviation of a logarithmic time between runs."""
ALPHA = 1e-3
"""Significance level on each side."""
FEW = 8
"""Smallest number of cells for which a backend's own median is used."""
RUNS = 3
"""Smallest number of runs of before, the first included, from which a spread is computed."""
NOTE = (
    f"A time counts if it changed by a factor of {EFFECT:g} or more and by more than the spread between runs. That spread "
    f"comes from {RUNS} or more runs of before (p < {2 * ALPHA:g} in Student's t). Without them, the ratio of the two times "
    f"must be {FAR:g} robust standard deviations from the median ratio of its backend's cells."
)

Runs = Mapping[Hashable, Row]


def judge_times(
    name: str, called: str, before: Runs, after: Runs, again: Sequence[Runs]
) -> tuple[dict[Hashable, Change], list[str]]:
    """Return the changes of the time column ``name`` by cell, and remarks.

    ``before``, ``after`` and each further run of before in ``again`` are rows by cell. ``called`` is the column's name in
    messages.
    """
    keys = [key for key in before if key in after and value(before[key], name) > 0 and value(after[key], name) > 0]
    if not keys:
        return {}, []
    runs = np.log([[value(run.get(key, {}), name) for run in (before, *again)] for key in keys])
    now = np.log([value(after[key], name) for key in keys])
    if runs.shape[1] >= RUNS:
        complete = np.asarray(np.isfinite(runs).all(axis=1))
        if not complete.any():
            return {}, ["no cell is in all runs of before, so times are not judged"]
        usual, far = _by_runs(runs, complete, now)
        remarks = []
        if not complete.all():
            remarks.append(
                f"times of {(~complete).sum()} cells are not judged, since some run of before lacks the cell"
            )
    else:
        backends = [str(before[key].get("backend", "")) for key in keys]
        usual, far, remarks = _by_cells(runs[:, 0], now, backends)
    changes = {}
    for key, was, new, differs in zip(keys, usual, now, far, strict=True):
        ratio = math.exp(new - was) if math.isfinite(was) else 1.0
        if differs and max(ratio, 1 / ratio) >= EFFECT:
            text = f"{called} {duration(math.exp(was))} to {duration(math.exp(new))} ({ratio:.2g} times)"
            changes[key] = Change("worse" if ratio > 1 else "better", text, called)
    return changes, remarks


def _by_runs(runs: np.ndarray, complete: np.ndarray, now: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each cell's mean logarithmic time before, and whether the time after is outside its prediction interval."""
    from scipy.special import stdtrit

    count = runs.shape[1]
    spread = max(LEAST_SPREAD, float(np.sqrt(runs[complete].var(axis=1, ddof=1).mean())))
    usual = runs.mean(axis=1)
    limit = float(stdtrit(count - 1, 1 - ALPHA)) * spread * math.sqrt(1 + 1 / count)
    return usual, complete & (np.abs(now - usual) > limit)


def _by_cells(was: np.ndarray, now: np.ndarray, backends: Sequence[str]) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return each cell's expected logarithmic time, whether the time after is far from it, and remarks.

    The expected time is the time before plus the median change of the cells of its backend.
    """
    ratios = now - was
    names = np.array(backends)
    usual, far, remarks = was.copy(), np.zeros(len(was), dtype=bool), []
    common = float(np.median(ratios))
    common_spread = 1.4826 * float(np.median(np.abs(ratios - common)))
    for name in dict.fromkeys(backends):
        mine = names == name
        is_large = mine.sum() >= FEW
        median = float(np.median(ratios[mine])) if is_large else common
        spread = 1.4826 * float(np.median(np.abs(ratios[mine] - median))) if is_large else common_spread
        spread = max(LEAST_SPREAD, spread, common_spread)
        usual[mine] += median
        far[mine] = np.abs(ratios[mine] - median) > FAR * spread
        if is_large and abs(median) > math.log(EFFECT):
            remarks.append(
                f"times on {name} are {math.exp(median):.2g} times those before in the median. Two runs cannot show "
                f"whether the machine or the code changed: name further runs of before with again=DIR,DIR ({RUNS} in all)"
            )
    return usual, far, remarks
