"""Recognises faults of a training in its stored log: which fault, from which update on, with the number that shows it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bench.model.trainer import LOGGED

from .. import mean_interval

DISAGREES = 0.1
"""Relative error of an applied gradient's slope above which it disagrees with central differences."""
FINITE = ("reward", "loss", "gradient_norm", "parameter_largest")
"""Quantities whose entries have to be finite."""

Verdict = dict[str, Any]
"""A fault: its ``code``, the ``value`` that shows it, and the ``update`` where it starts if it has one."""
Found = tuple[Any, Any] | None
"""The value that shows a fault, and the updates that show it, which may be empty; None: no fault."""


def series(values: Any) -> np.ndarray:
    """Return a stored list, empty where a row has none, which may be NaN."""
    return np.asarray(values, dtype=float) if np.ndim(values) else np.empty(0)


def _known(values: Any) -> np.ndarray:
    """Return the entries of a stored list that are not NaN."""
    numbers = series(values)
    return numbers[~np.isnan(numbers)]


class _Training:
    """A stored run: each logged quantity as a series, NaN where the trainer logs nothing, which is no fault."""

    def __init__(self, run: Mapping[str, Any]) -> None:
        self.run = run
        self.logged = {name: series(run[f"log_{name}"]) for name in ("update", *LOGGED)}
        nothing = np.full(max(self.logged["update"].size, 1), math.nan)
        known = {name: values if values.size else nothing for name, values in self.logged.items()}
        self.updates, self.norms, self.largest = known["update"], known["gradient_norm"], known["parameter_largest"]
        self.reward, self.depth, self.deviation = known["reward"], known["penetration"], known["deviation"]
        self.tenth = max(len(self.updates) // 10, 1)
        self.late = np.median(self.norms[-self.tenth :])

    def curve(self, end: str) -> np.ndarray:
        """Return the returns of the evaluations, or an end of their intervals."""
        return np.asarray(self.run[f"curve_return{end}"], dtype=float)

    def rises(self, since: float) -> bool:
        """Return whether the last return is certainly above that of the last evaluation up to an update."""
        at = max(int((np.asarray(self.run["curve_update"], dtype=float) <= since).sum()) - 1, 0)
        return bool(self.curve("_low")[-1] > self.curve("_high")[at])

    def is_lower_first(self, values: np.ndarray) -> bool:
        """Return whether the mean of the first tenth is certainly below that of the last, by Welch's test at 5% (two sides)."""
        from scipy.stats import ttest_ind

        ends = values[: self.tenth], values[-self.tenth :]
        return bool(ttest_ind(*ends, equal_var=False, alternative="less").pvalue < 0.025)


def _not_finite(training: _Training) -> Found:
    logged = training.logged
    bad = [logged["update"][at] for name in FINITE for at in np.flatnonzero(~np.isfinite(logged[name]))[:1]]
    return (math.nan, bad[-1:]) if bad else None


def _zero(training: _Training) -> Found:
    norms, stated = training.norms, training.run["gradient_zero"]
    silent = stated if math.isfinite(stated) else (norms == 0).mean()
    # fewer may come from saturated actions
    return (silent, training.updates[[norms.argmin()]]) if np.isfinite(norms).all() and silent > 0.2 else None


def _explodes(training: _Training) -> Found:
    peak, usual = training.norms.max(), np.quantile(training.norms, 0.9)
    # clipping absorbs smaller peaks
    return (peak / usual, training.updates[[training.norms.argmax()]]) if math.inf > peak > 200.0 * usual > 0 else None


def _grows(training: _Training) -> Found:
    norms, late = training.norms, training.late
    first = norms[: max((training.updates <= 10).sum(), 1)].min()
    return (late / first, training.updates[norms > FACTOR * first]) if late > FACTOR * first > 0 else None


def _vanishes(training: _Training) -> Found:
    early, late, updates = np.median(training.norms[: training.tenth]), training.late, training.updates
    if not 0 < late < early / FACTOR:
        return None
    since = updates[training.norms >= early / FACTOR].max(initial=0.0)
    return (late / early, [since]) if since < updates[-training.tenth :][0] and not training.rises(since) else None


def _differences(training: _Training) -> Found:
    error = _known(training.run["slope_errors"]).max(initial=0.0)
    return (error, []) if error > DISAGREES else None


def _opposed(training: _Training) -> Found:
    cosines = _known(training.run["cosine"])
    # an interval of the cosine needs three comparisons
    is_opposed = len(cosines) >= 3 and mean_interval(cosines)[2] < 0
    return (cosines.sum() / len(cosines), []) if is_opposed else None


def _falls(training: _Training) -> Found:
    # the last return is far below the best one, whatever the loss does
    mean, low, high = (training.curve(end) for end in ("", "_low", "_high"))
    best = np.argmax(np.nan_to_num(mean, nan=-math.inf))
    lost = mean[best] - mean[-1]
    has_fallen = high[-1] < low[best] and lost > 0.5 * (mean[best] - mean[0])
    return (lost, [training.run["curve_update"][best]]) if has_fallen else None


def _soft_contact(training: _Training) -> Found:
    tenth, depth = training.tenth, training.depth
    deeper = depth[-tenth:].mean() / depth[:tenth].mean()
    is_deeper = tenth > 1 and 2.0 < deeper < math.inf
    return (
        (deeper, [])
        if is_deeper and training.is_lower_first(training.reward) and training.is_lower_first(depth)
        else None
    )


def _parameters(training: _Training) -> Found:
    largest, most = training.largest, 10.0 * training.largest[0]
    return (largest.max() / largest[0], training.updates[largest > most]) if largest.max() > most else None


def _deviation(training: _Training) -> Found:
    # the scale of actions is about 1
    outside = np.flatnonzero((training.deviation < 1e-3) | (training.deviation > 1e2))
    return (training.deviation[outside[0]], training.updates[outside]) if outside.size else None


FACTOR = 100.0
"""Factor between the gradients at the start and in the last tenth of a run above which they grow or vanish."""
RULES = {
    "not_finite": (_not_finite, "a loss, gradient or parameter is not finite"),
    "zero": (_zero, "share of updates with a gradient of exactly 0"),
    "explodes": (_explodes, "largest gradient, relative to that which nine of ten updates stay below"),
    "grows": (_grows, "gradient of the last tenth, relative to the smallest of the first ten updates"),
    "vanishes": (
        _vanishes,
        "gradient of the last tenth, relative to the first tenth, while the return rises no more",
    ),
    "differences": (
        _differences,
        "largest relative error of the applied gradient's slope, along a random direction in an array of the policy",
    ),
    "opposed": (_opposed, "cosine between first- and zeroth-order gradients, certainly below 0"),
    "falls": (_falls, "return lost since its best evaluation, more than half of the rise before"),
    "soft_contact": (
        _soft_contact,
        "factor on the penetration while the reward rises: the policy uses the soft contact",
    ),
    "parameters": (_parameters, "largest parameter of the policy, relative to its first value"),
    "deviation": (_deviation, "standard deviation of the actions, which is unphysical"),
}
"""By code: the function that recognises the fault, and what its value is."""


@np.errstate(all="ignore")
def judge(run: Mapping[str, Any]) -> list[Verdict]:
    """Return the faults that a stored run shows, in the order of :data:`RULES`; empty for a healthy run.

    What noise can explain does not count: means are compared by a test, and evaluations need their intervals apart.
    """
    training, verdicts = _Training(run), []
    for code, (fault, _) in RULES.items():
        if found := fault(training):
            value, updates = found
            verdicts.append(
                {"code": code, "value": float(value)} | ({"update": int(updates[0])} if len(updates) else {})
            )
    return verdicts
