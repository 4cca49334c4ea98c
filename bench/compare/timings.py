"""Judges times against the spread between runs, never against that within one run.

The calls of one run share its load, clock and memory layout, so their spread says little about the next run. Two rules:

- With further runs of *before* (``again=DIR,DIR``): the logarithms of a cell's times over K runs have a mean and, pooled
  over all cells, a variance; a time after is changed where it leaves the central 1 - 2 ALPHA of Student's t with K - 1
  degrees of freedom, the prediction interval of one more run. K - 1, since the cells of one run are not independent.
- Without: each cell against all others of its backend. The median of the logarithmic ratios is what the whole run
  gained or lost, which no single pair of runs can divide between machine and code: it is reported as a remark. A cell is
  changed where it is FAR robust standard deviations from that median.

In both cases the change is also at least EFFECT.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from bench.compare.judging import Change, Row, value
from bench.report.text import duration

EFFECT = 1.5
"""Ratio below which no time counts as changed."""
FAR = 6.0
"""Robust standard deviations from the median ratio of the backend's cells beyond which a cell differs from them."""
LEAST_SPREAD = 0.05
"""Least standard deviation between runs of a logarithmic time that is assumed."""
ALPHA = 1e-3
FEW = 8
"""Cells of a backend below which it is judged together with the others."""
RUNS = 3
"""Least runs of before, the first one included, whose spread is used."""
NOTE = (
    f"A time counts where it changed by a factor of {EFFECT:g} or more and by more than the spread between runs: that of "
    f"the further runs of before, {RUNS} in all or more (p < {2 * ALPHA:g} in Student's t), or without them {FAR:g} robust "
    "standard deviations of the ratios of all cells of its backend, measured from their median."
)

Runs = Mapping[Hashable, Row]


def judged(
    name: str, called: str, before: Runs, after: Runs, again: Sequence[Runs]
) -> tuple[dict[Hashable, Change], list[str]]:
    """Return the changes of a time by cell, and remarks; ``before``, ``after`` and ``again`` are rows by cell."""
    keys = [key for key in before if key in after and value(before[key], name) > 0 and value(after[key], name) > 0]
    if not keys:
        return {}, []
    runs = np.log([[value(run.get(key, {}), name) for run in (before, *again)] for key in keys])
    now = np.log([value(after[key], name) for key in keys])
    if runs.shape[1] >= RUNS:
        complete = np.asarray(np.isfinite(runs).all(axis=1))
        if not complete.any():
            return {}, ["the further runs of before have no cell in common with it: times are not judged"]
        usual, far = _by_runs(runs, complete, now)
        remarks = (
            [] if complete.all() else [f"times of {(~complete).sum()} cells are not judged: not in every run of before"]
        )
    else:
        backends = [str(before[key].get("backend", "")) for key in keys]
        usual, far, remarks = _by_cells(runs[:, 0], now, backends)
    changes = {}
    for key, was, is_now, differs in zip(keys, usual, now, far, strict=True):
        ratio = math.exp(is_now - was) if math.isfinite(was) else 1.0
        if differs and max(ratio, 1 / ratio) >= EFFECT:
            text = f"{called} {duration(math.exp(was))} to {duration(math.exp(is_now))} ({ratio:.2g} times)"
            changes[key] = Change("worse" if ratio > 1 else "better", text)
    return changes, remarks


def _by_runs(runs: np.ndarray, complete: np.ndarray, now: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each cell's usual logarithmic time, and whether the one after is outside the spread between runs."""
    from scipy.special import stdtrit

    count = runs.shape[1]
    spread = max(LEAST_SPREAD, float(np.sqrt(runs[complete].var(axis=1, ddof=1).mean())))
    usual = runs.mean(axis=1)
    limit = float(stdtrit(count - 1, 1 - ALPHA)) * spread * math.sqrt(1 + 1 / count)
    return usual, complete & (np.abs(now - usual) > limit)


def _by_cells(was: np.ndarray, now: np.ndarray, backends: Sequence[str]) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return each cell's time before, shifted as all of its backend's were, whether it is far from that, and remarks."""
    ratios = now - was
    names = np.array(backends)
    usual, far, remarks = was.copy(), np.zeros(len(was), dtype=bool), []
    common = float(np.median(ratios))
    everywhere = 1.4826 * float(np.median(np.abs(ratios - common)))
    for name in dict.fromkeys(backends):
        mine = names == name
        several = mine.sum() >= FEW
        median = float(np.median(ratios[mine])) if several else common
        spread = 1.4826 * float(np.median(np.abs(ratios[mine] - median))) if several else everywhere
        spread = max(LEAST_SPREAD, spread, everywhere)
        usual[mine] += median
        far[mine] = np.abs(ratios[mine] - median) > FAR * spread
        if several and abs(median) > math.log(EFFECT):
            remarks.append(
                f"times on {name} are {math.exp(median):.2g} times those before in the median: two runs cannot say whether "
                f"that is the machine or the code; name further runs of before with again=DIR,DIR ({RUNS} in all)"
            )
    return usual, far, remarks
