"""Recognises faults of a training in its stored log: which fault, from which update on, with the number that shows it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bench.model.trainer import LOGGED

from .. import mean_interval

FACTOR = 100.0
"""Factor between the gradients of the first ten updates and of the last tenth of a run, above which it grows or vanishes."""
PEAK, USUAL = 200.0, 0.9
"""Factor on a run's usual gradient, this quantile of all, above which one explodes; clipping absorbs smaller peaks."""
FIRST = 10
"""Updates at the start whose smallest gradient is compared with the last tenth of a run."""
SILENT = 0.2
"""Share of updates with a gradient of exactly 0 that is a fault: less may come from saturated actions."""
LOST = 0.5
"""Share of the rise of a return whose loss by the end is a fault."""
DOUBLED = 2.0
"""Factor on the largest penetration that counts as an exploited contact."""
GROWN = 10.0
"""Factor on the first largest parameter above which a policy's parameters are unphysical."""
DEVIATIONS = (1e-3, 1e2)
"""Range of plausible standard deviations of actions, whose scale is about 1."""
DISAGREES = 0.1
"""Relative error of an applied gradient's slope above which it disagrees with central differences."""
MIN_CHECKS = 3
"""Fewest comparisons of gradients for an interval of their cosine."""
FINITE = ("reward", "loss", "gradient_norm", "parameter_largest")
"""Quantities whose entries have to be finite."""
MEANINGS = {
    "not_finite": "a loss, gradient or parameter is not finite",
    "zero": "share of updates with a gradient of exactly 0",
    "explodes": "largest gradient, relative to that which nine of ten updates stay below",
    "grows": "gradient of the last tenth, relative to the smallest of the first ten updates",
    "vanishes": "gradient of the last tenth, relative to the first tenth, while the return rises no more",
    "differences": "largest relative error of the applied gradient's slope, along a random direction in an array of the policy",
    "opposed": "cosine between first- and zeroth-order gradients, certainly below 0",
    "falls": "return lost since its best evaluation, more than half of the rise before",
    "soft_contact": "factor on the penetration while the reward rises: the policy uses the soft contact",
    "parameters": "largest parameter of the policy, relative to its first value",
    "deviation": "standard deviation of the actions, which is unphysical",
}
"""What the value of each fault is."""

Verdict = dict[str, Any]
"""A fault: its ``code``, the ``value`` that shows it, and the ``update`` where it starts if it has one."""


@np.errstate(all="ignore")
def judge(run: Mapping[str, Any]) -> list[Verdict]:
    """Return the faults that a stored run shows, in the order of :data:`MEANINGS`; empty for a healthy run.

    What noise can explain does not count: means are compared by a test, and evaluations need their intervals apart.
    """
    log = {name: series(run[f"log_{name}"]) for name in ("update", *LOGGED)}
    bad = [log["update"][at] for name in FINITE for at in np.flatnonzero(~np.isfinite(log[name]))[:1]]
    # what a trainer does not log is NaN, which is no fault
    nothing = np.full(max(log["update"].size, 1), math.nan)
    known = {name: values if values.size else nothing for name, values in log.items()}
    updates, norms, largest = known["update"], known["gradient_norm"], known["parameter_largest"]
    reward, depth, deviation = known["reward"], known["penetration"], known["deviation"]
    tenth = max(len(updates) // 10, 1)
    early, late, usual = np.median(norms[:tenth]), np.median(norms[-tenth:]), np.quantile(norms, USUAL)
    first = norms[: max((updates <= FIRST).sum(), 1)].min()
    silent = run["gradient_zero"] if math.isfinite(run["gradient_zero"]) else (norms == 0).mean()
    small = updates[norms >= early / FACTOR].max(initial=0.0)
    has_vanished = 0 < late < early / FACTOR and small < updates[-tenth:][0] and not _rises(run, small)
    error, cosines = _known(run["slope_errors"]).max(initial=0.0), _known(run["cosine"])
    mean, low, high = (np.asarray(run[f"curve_return{end}"], dtype=float) for end in ("", "_low", "_high"))
    best = np.argmax(np.nan_to_num(mean, nan=-math.inf))
    lost = mean[best] - mean[-1]
    outside = np.flatnonzero((deviation < DEVIATIONS[0]) | (deviation > DEVIATIONS[1]))
    deeper = depth[-tenth:].mean() / depth[:tenth].mean()
    is_used = tenth > 1 and DOUBLED < deeper < math.inf and all(
        _is_below(values[:tenth], values[-tenth:]) for values in (reward, depth)
    )  # fmt: skip
    faults = {
        "not_finite": (bad, math.nan, bad[-1:]),
        "zero": (np.isfinite(norms).all() and silent > SILENT, silent, updates[[norms.argmin()]]),
        "explodes": (math.inf > norms.max() > PEAK * usual > 0, norms.max() / usual, updates[[norms.argmax()]]),
        "grows": (late > FACTOR * first > 0, late / first, updates[norms > FACTOR * first]),
        "vanishes": (has_vanished, late / early, [small]),
        "differences": (error > DISAGREES, error, []),
        "opposed": (len(cosines) >= MIN_CHECKS and mean_interval(cosines)[2] < 0, cosines.sum() / len(cosines), []),
        # the last return is far below the best one, whatever the loss does
        "falls": (high[-1] < low[best] and lost > LOST * (mean[best] - mean[0]), lost, [run["curve_update"][best]]),
        "soft_contact": (is_used, deeper, []),
        "parameters": (largest.max() > GROWN * largest[0], largest.max() / largest[0], updates[largest > GROWN * largest[0]]),
        "deviation": (outside.size, deviation[outside[:1]].sum(), updates[outside]),
    }  # fmt: skip
    return [
        {"code": code, "value": float(value)} | ({"update": int(where[0])} if len(where) else {})
        for code, (is_fault, value, where) in faults.items() if is_fault
    ]  # fmt: skip


def series(values: Any) -> np.ndarray:
    """Return a stored list, empty where a row has none, which may be NaN."""
    return np.asarray(values, dtype=float) if np.ndim(values) else np.empty(0)


def _known(values: Any) -> np.ndarray:
    """Return the entries of a stored list that are not NaN."""
    numbers = series(values)
    return numbers[~np.isnan(numbers)]


def _rises(run: Mapping[str, Any], since: float) -> bool:
    """Return whether the last return is certainly above that of the last evaluation up to an update."""
    at = max(int((np.asarray(run["curve_update"], dtype=float) <= since).sum()) - 1, 0)
    return bool(run["curve_return_low"][-1] > run["curve_return_high"][at])


def _is_below(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether the mean of ``a`` is certainly below that of ``b``, by Welch's test at 5% (two sides)."""
    from scipy.stats import ttest_ind

    return bool(ttest_ind(a, b, equal_var=False, alternative="less").pvalue < 0.025)
