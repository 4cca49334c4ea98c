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


def judge(run: Mapping[str, Any]) -> list[Verdict]:
    """Return the faults that a stored run shows, in the order of :data:`MEANINGS`; empty for a healthy run.

    What noise can explain does not count: means are compared by a test, and evaluations need their intervals apart.
    """
    updates = series(run["log_update"])
    log = {name: series(run[f"log_{name}"]) for name in LOGGED}
    norms, tenth = log["gradient_norm"], max(len(updates) // 10, 1)
    found: dict[str, Verdict] = {}

    def check(code: str, is_fault: Any, value: Any, where: Any = None) -> None:
        if is_fault:
            found[code] = {"code": code, "value": float(value)}
            if where is not None:
                found[code]["update"] = int(where)

    for name in FINITE:
        bad = np.flatnonzero(~np.isfinite(log[name]))
        check("not_finite", bad.size, math.nan, updates[bad[:1]].sum())
    if len(norms) and np.isfinite(norms).all():
        zero = run["gradient_zero"] if math.isfinite(run["gradient_zero"]) else float((norms == 0).mean())
        check("zero", zero > SILENT, zero, updates[np.argmin(norms)])
        usual, late = float(np.quantile(norms, USUAL)), float(np.median(norms[-tenth:]))
        check("explodes", norms.max() > PEAK * usual > 0, norms.max() / max(usual, 1e-300), updates[np.argmax(norms)])
        first = float(norms[: max(int((updates <= FIRST).sum()), 1)].min())
        check("grows", late > FACTOR * first > 0, late / max(first, 1e-300), updates[np.argmax(norms > FACTOR * first)])
        early = float(np.median(norms[:tenth]))
        small = updates[np.flatnonzero(norms >= early / FACTOR)[-1]]
        has_vanished = 0 < late < early / FACTOR and small < updates[-tenth] and not _rises(run, small)
        check("vanishes", has_vanished, late / early if early else math.nan, small)
    errors = _known(run["slope_errors"])
    check("differences", errors.max(initial=0.0) > DISAGREES, errors.max(initial=0.0))
    cosines = _known(run["cosine"])
    check(
        "opposed", len(cosines) >= MIN_CHECKS and mean_interval(cosines)[2] < 0, cosines.mean() if len(cosines) else 0.0
    )
    mean, low, high = (np.asarray(run[f"curve_return{end}"], dtype=float) for end in ("", "_low", "_high"))
    if np.isfinite(mean).any():
        # the last return is far below the best one, whatever the loss does
        best = int(np.nanargmax(mean))
        lost = mean[best] - mean[-1]
        is_lost = high[-1] < low[best] and lost > LOST * (mean[best] - mean[0])
        check("falls", is_lost, lost, run["curve_update"][best])
    reward, depth = log["reward"], log["penetration"]
    if len(depth) >= 3 * tenth and tenth > 1 and depth[:tenth].mean() > 0:
        factor = depth[-tenth:].mean() / depth[:tenth].mean()
        is_used = _is_below(reward[:tenth], reward[-tenth:]) and _is_below(depth[:tenth], depth[-tenth:])
        check("soft_contact", is_used and factor > DOUBLED, factor)
    largest, deviation = log["parameter_largest"], log["deviation"]
    if len(largest):
        check("parameters", largest.max() > GROWN * largest[0], largest.max() / largest[0],
              updates[np.argmax(largest > GROWN * largest[0])])  # fmt: skip
    outside = np.flatnonzero((deviation < DEVIATIONS[0]) | (deviation > DEVIATIONS[1]))
    check("deviation", outside.size, deviation[outside[:1]].sum(), updates[outside[:1]].sum())
    return [found[code] for code in MEANINGS if code in found]


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
