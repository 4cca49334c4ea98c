"""Recognises faults of a training in its log: which fault, at which update, with the numbers that show it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

EXPLODES = 100.0
"""Factor on the median norm of the updates before, above which a gradient explodes."""
LARGE = 10.0
"""Factor on the largest of those medians so far that an explosion exceeds too; below it, the gradient was small before."""
MEMORY = 50
"""Updates before, whose median norm is compared."""
SETTLED = 10
"""Fewest updates before, so that a first few small gradients make no explosion."""
RECENT = 10
"""Updates within which a start of contact is named beside an explosion."""
SILENT = 10
"""Updates in a row with a gradient of exactly 0 that count as a fault: one may be an accident of a saturated start."""
DOUBLED = 2.0
"""Factor on the largest penetration that counts as an exploited contact."""
GROWN = 100.0
"""Factor on the first largest parameter above which a policy's parameters are unphysical."""
DEVIATIONS = (1e-3, 1e2)
"""Range of plausible standard deviations of actions, whose scale is about 1."""
ALWAYS = 0.9
"""Share of cut windows above which a gradient seldom reaches the end of a window."""
DISAGREES = 0.1
"""Relative error of a directional derivative above which it disagrees with central differences; rounding of float64 stays below."""
MIN_CHECKS = 3
"""Fewest comparisons of gradients for an interval of their cosine."""

Verdict = dict[str, Any]
"""A fault: its ``code``, ``update`` where it starts if it has one, and the numbers that show it."""


class Log:
    """The log of a run: numbers by update, counted from 1."""

    def __init__(self, entries: Sequence[Mapping[str, Any]] = ()) -> None:
        self._entries: list[dict[str, float]] = []
        self.first_not_finite: tuple[int, str] | None = None
        """The first update with a loss, gradient or parameter that is not finite, and the quantity."""
        self.extend(entries)

    def __len__(self) -> int:
        return len(self._entries)

    def extend(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Add the logs of further updates."""
        for entry in entries:
            values = {name: float(value) for name, value in entry.items()}
            self._entries.append(values)
            bad = [
                n
                for n in ("reward", "loss", "gradient_norm", "parameter_largest")
                if not math.isfinite(values.get(n, 0.0))
            ]
            if bad and self.first_not_finite is None:
                self.first_not_finite = (len(self._entries), bad[0].replace("_", " "))

    def column(self, name: str) -> np.ndarray:
        """Return one quantity by update, ``(n,)``; NaN where a trainer does not have it."""
        return np.array([entry.get(name, math.nan) for entry in self._entries])


def judge(
    log: Log, evaluated: np.ndarray, returns: np.ndarray, cosines: np.ndarray, probe: Mapping[str, float]
) -> list[Verdict]:
    """Return the faults that a log shows, in the order of a user's questions; empty for a healthy run.

    ``evaluated (k,)`` are the updates at which the policy was evaluated, ``returns (k, 3)`` mean and interval of its
    return there, ``cosines (c, 3)`` update, cosine and cosine without noise. A statement about means needs their
    intervals apart; what noise can explain does not count.
    """
    explosion = _explodes(log)
    checks = [
        _not_finite(log), _zero(log), _vanishes(log, evaluated, returns), explosion or _grows(log), _differences(probe),
        _cosine(cosines), _worse(log, evaluated, returns), _soft_contact(log), _parameters(log), _always_cut(log),
    ]  # fmt: skip
    return [verdict for verdict in checks if verdict is not None]


def contact_start(contacts: np.ndarray) -> int | None:
    """Return the first update with a closed contact after updates without one, or None."""
    closed = np.flatnonzero(np.nan_to_num(contacts) > 0)
    return int(closed[0]) + 1 if closed.size and closed[0] > 0 else None


def _not_finite(log: Log) -> Verdict | None:
    if log.first_not_finite is None:
        return None
    update, quantity = log.first_not_finite
    return {"code": "not_finite", "update": update, "quantity": quantity}


def _zero(log: Log) -> Verdict | None:
    zero = log.column("gradient_norm") == 0.0
    start = _run_of(zero, min(SILENT, len(log)))
    return (
        None if start is None else {"code": "zero", "update": start + 1, "zero": int(zero.sum()), "updates": len(log)}
    )


def _run_of(flags: np.ndarray, length: int) -> int | None:
    """Return where the first run of at least ``length`` true flags starts, or None."""
    count = 0
    for i, flag in enumerate(flags):
        count = count + 1 if flag else 0
        if count and count >= length:
            return i - count + 1
    return None


def _explodes(log: Log) -> Verdict | None:
    norms = log.column("gradient_norm")
    typical, highest = _medians(norms)
    jumps = [i for i in range(len(norms)) if typical[i] > 0 and norms[i] > EXPLODES * typical[i]]
    if not jumps:
        return None
    peaks = [i for i in jumps if norms[i] > LARGE * highest[i]]
    if not peaks:
        return {"code": "returns", "update": jumps[0] + 1, "factor": float(norms[jumps[0]] / typical[jumps[0]])}
    first = peaks[0]
    verdict: Verdict = {"code": "explodes", "update": first + 1, "factor": float(norms[first] / typical[first])}
    contacts = log.column("contacts")
    start = contact_start(contacts)
    if start is not None and 0 <= first + 1 - start <= RECENT:
        verdict["contact"] = start
    later = norms[first:][np.isfinite(norms[first:])]
    if len(later) >= SETTLED and np.median(later) > EXPLODES * highest[first]:
        return verdict | {"peaks": 1, "lasting": float(np.median(later) / typical[first])}
    verdict["peaks"] = len(peaks)
    # whether peaks come with contact: updates with more contacts than the median
    if np.nanmax(contacts, initial=0.0) > 0:
        verdict["with_contact"] = int(sum(contacts[i] > 0 for i in peaks))
    return verdict


def _medians(norms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, by update, the median norm of the :data:`MEMORY` updates before, and its largest value so far; NaN at first."""
    typical = np.full(len(norms), math.nan)
    for i in range(SETTLED, len(norms)):
        before = norms[max(0, i - MEMORY) : i]
        if np.isfinite(before).any():
            typical[i] = np.median(before[np.isfinite(before)])
    return typical, np.fmax.accumulate(typical) if len(typical) else typical


def _vanishes(log: Log, evaluated: np.ndarray, returns: np.ndarray) -> Verdict | None:
    """Return that the gradient has become small, not 0, and stays so, while the return does not rise."""
    norms, tenth = log.column("gradient_norm"), max(len(log) // 10, SETTLED)
    if len(norms) < 2 * tenth or not np.isfinite(norms).all() or not norms[-tenth:].any():
        return None
    highest = float(np.nanmax(_medians(norms)[1]))
    start = int(np.flatnonzero(norms >= highest / EXPLODES)[-1]) + 1
    if start > len(norms) - tenth:
        return None
    before = returns[evaluated <= start]
    if len(before) and returns[-1, 1] > before[-1, 2]:
        return None
    return {"code": "vanishes", "update": start + 1, "factor": highest / float(np.median(norms[start:]))}


def _grows(log: Log) -> Verdict | None:
    """Return that the gradient grows without a jump: at the end of a run it is much larger than at its start."""
    norms, tenth = log.column("gradient_norm"), max(len(log) // 10, SETTLED)
    if len(norms) < 2 * tenth or not np.isfinite(norms).all():
        return None
    first = float(np.median(norms[:tenth]))
    if not (first > 0 and (norms[-tenth:] > EXPLODES * first).all()):
        return None
    start = int(np.flatnonzero(norms <= EXPLODES * first)[-1]) + 1
    return {"code": "grows", "update": start + 1, "factor": float(np.median(norms[-tenth:])) / first}


def _differences(probe: Mapping[str, float]) -> Verdict | None:
    error = probe.get("difference_error", math.nan)
    return {"code": "differences", "error": error} if error > DISAGREES else None


def _cosine(cosines: np.ndarray) -> Verdict | None:
    values = cosines[np.isfinite(cosines[:, 1]), 1] if len(cosines) else np.empty(0)
    if len(values) < MIN_CHECKS:
        return None
    low, high = _student(values)
    return {"code": "opposed", "cosine": float(values.mean()), "low": low, "high": high} if high < 0 else None


def _student(values: np.ndarray) -> tuple[float, float]:
    """Return Student's 95% interval of the mean of independent values."""
    from scipy.special import stdtrit

    half = float(stdtrit(len(values) - 1, 0.975)) * float(values.std(ddof=1)) / math.sqrt(len(values))
    return float(values.mean()) - half, float(values.mean()) + half


def _worse(log: Log, evaluated: np.ndarray, returns: np.ndarray) -> Verdict | None:
    """Return that the loss falls while the evaluated return worsens, from the best evaluation to the last."""
    if len(returns) < 2 or not np.isfinite(returns[:, 0]).any():
        return None
    best = int(np.nanargmax(returns[:, 0]))
    if not returns[-1, 2] < returns[best, 1]:
        return None
    loss, tenth = log.column("loss"), max(len(log) // 10, 2)
    at = min(int(evaluated[best]), len(log) - tenth)
    early, late = loss[max(at - tenth // 2, 0) :][:tenth], loss[-tenth:]
    if at + tenth > len(log) - tenth or not _is_below(late, early):
        return None
    return {
        "code": "worse", "update": int(evaluated[best]), "best": float(returns[best, 0]), "last": float(returns[-1, 0]),
        "loss_before": float(early.mean()), "loss_after": float(late.mean()),
    }  # fmt: skip


def _is_below(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether the mean of ``a`` is certainly below that of ``b``: their Student intervals do not overlap."""
    if len(a) < 2 or len(b) < 2 or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return False
    return _student(a)[1] < _student(b)[0]


def _soft_contact(log: Log) -> Verdict | None:
    reward, depth, tenth = log.column("reward"), log.column("penetration"), max(len(log) // 10, 2)
    if len(log) < 3 * tenth or not np.nanmax(depth, initial=0.0) > 0:
        return None
    early, late = depth[:tenth], depth[-tenth:]
    if not (_is_below(reward[:tenth], reward[-tenth:]) and _is_below(early, late)):
        return None
    factor = float(late.mean() / early.mean()) if early.mean() > 0 else math.inf
    if factor < DOUBLED or math.isinf(factor):
        return None
    return {
        "code": "soft_contact", "factor": factor, "before": float(early.mean()), "after": float(late.mean()),
        "reward_before": float(reward[:tenth].mean()), "reward_after": float(reward[-tenth:].mean()),
    }  # fmt: skip


def _parameters(log: Log) -> Verdict | None:
    largest, deviation = log.column("parameter_largest"), log.column("deviation")
    grown = np.flatnonzero(largest > GROWN * largest[0]) if len(largest) else np.empty(0, int)
    if grown.size:
        at = int(grown[0])
        return {"code": "parameters", "update": at + 1, "first": float(largest[0]), "value": float(largest[at])}
    outside = np.flatnonzero((deviation < DEVIATIONS[0]) | (deviation > DEVIATIONS[1]))
    if outside.size:
        at = int(outside[0])
        return {"code": "deviation", "update": at + 1, "value": float(deviation[at])}
    return None


def _always_cut(log: Log) -> Verdict | None:
    share = float(np.nanmean(log.column("cut"))) if len(log) else 0.0
    return {"code": "cut", "share": share} if share > ALWAYS else None
