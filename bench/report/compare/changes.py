"""What changed of each cell, beyond what the two measurements leave open.

- Bias: the two 95% intervals are apart.
- Variance: the two 95% intervals are apart where both are stored, else the ratio leaves the central 99% of an F
  distribution with R - 1 degrees of freedom on both sides (normal estimates of one dominant component: the fewest there can
  be). Only where it is by EFFECT at least.
- Errors that are computed and not estimated (EXACT): by EFFECT at least, and by more than ROUNDING of what they are of.
- Growth rate: the two 95% intervals are apart; faster is neither better nor worse.
- Time: the medians differ by EFFECT at least and, of the stored times of single calls, a two-sided Mann-Whitney test
  (Mann and Whitney 1947) has p < ALPHA; without those, the middle halves of the calls (median and half its
  interquartile range on each side) are apart.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from bench.report.views import duration, number
from bench.store import IDENTITY

EFFECT = 1.25
"""Ratio below which neither a variance nor a time counts as changed."""
ALPHA = 0.01
EXACT = {
    "forward_error_rel": "forward error", "program_error_rel": "program error", "model_error_rel": "model error",
    "relative_error": "error", "state_difference_rel": "difference of states",
    "gradient_difference_rel": "difference of gradients",
}  # fmt: skip
"""Relative errors without noise, of the studies that have them."""
ROUNDING = 1e-6
"""Change of such an error that another machine's rounding may make through a long rollout."""
MEASURED = ("bias_rel", "rmse_rel", "time_s")
"""Columns told of both sides."""
COLUMNS = [
    "outcome", "change", *IDENTITY, "status_before", "status_after",
    *(f"{name}_{when}" for name in MEASURED for when in ("before", "after")), "time_judged_by",
]  # fmt: skip
NOTES = (
    "worse, better: a bias whose 95% interval is apart from the one before; a variance that is too (or, without its "
    f"interval, outside 99% of an F test) and differs by {EFFECT:g} times or more; a time that differs by {EFFECT:g} times or "
    f"more with p < {ALPHA:g} in a Mann-Whitney test of the single calls (or, without them, with interquartile ranges apart).",
    f"Errors computed without noise (of cost, program, model, twin) count by {EFFECT:g} times and more than {ROUNDING:g}; a growth "
    "rate with its interval apart is changed, neither worse nor better.",
    "A cell that was ok and is not, or is gone, is worse. A cell that is new is neither, nor is one whose intervals were "
    "remarked to be doubtful.",
    f"Each cell is judged by itself: of cells that did not change up to {ALPHA:.0%} may be told as changed by chance.",
)


def compared(before: pd.DataFrame, after: pd.DataFrame, timings: bool) -> pd.DataFrame:
    """A line per cell of either side: its identity, what became of it, and by what its time was judged."""
    old, new = _by_identity(before), _by_identity(after)
    lines = [_line(old.get(key), new.get(key), timings) for key in dict.fromkeys([*old, *new])]
    return pd.DataFrame(lines, columns=COLUMNS)


def _by_identity(rows: pd.DataFrame) -> dict[tuple[str, ...], dict[str, Any]]:
    named = rows.reindex(columns=[*IDENTITY])
    texts = [
        [value if isinstance(value, str) else f"{value:.12g}" for value in row] for row in named.to_numpy(dtype=object)
    ]
    records = ({str(name): value for name, value in row.items()} for row in rows.to_dict("records"))
    return {tuple(text): row for text, row in zip(texts, records, strict=True)}


def _line(old: dict[str, Any] | None, new: dict[str, Any] | None, timings: bool) -> dict[str, Any]:
    """One cell."""
    there = new if new is not None else old
    assert there is not None
    line = {name: there.get(name) for name in IDENTITY}
    for when, row in (("before", old), ("after", new)):
        line |= {f"{name}_{when}": math.nan if row is None else row.get(name, math.nan) for name in MEASURED}
        line[f"status_{when}"] = "" if row is None else row["status"]
    changes: list[tuple[str, str]] = []
    judged_by = ""
    if old is None or new is None:
        changes.append(_gone(old))
    elif "ok" not in (old["status"], new["status"]) or old["status"] != new["status"]:
        changes += _status(old, new)
    else:
        accuracy = [_sure(found, old, new) for found in (_bias(old, new), _variance(old, new))]
        changes += filter(None, [_verdict(old, new), *accuracy, *_exact(old, new), _growth(old, new)])
        if timings:
            found, judged_by = _time(old, new)
            changes += [found] if found else []
    outcomes = {outcome for outcome, _ in changes}
    outcome = next((o for o in ("worse", "better", "changed") if o in outcomes), "same")
    return line | {"outcome": outcome, "change": "; ".join(text for _, text in changes), "time_judged_by": judged_by}


def _gone(old: Mapping[str, Any] | None) -> tuple[str, str]:
    if old is None:
        return "changed", "new"
    return ("worse" if old["status"] == "ok" else "changed"), f"gone, it was {old['status']}"


def _status(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[tuple[str, str]]:
    if old["status"] == new["status"]:
        return []
    kind = "worse" if old["status"] == "ok" else "better" if new["status"] == "ok" else "changed"
    reason = f" ({new['reason']})" if isinstance(new.get("reason"), str) and new["reason"] else ""
    return [(kind, f"status {old['status']} to {new['status']}{reason}")]


def _verdict(old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, str] | None:
    was, now = old.get("verdict", ""), new.get("verdict", "")
    if was == now:
        return None
    return ("worse" if was == "ok" else "better" if now == "ok" else "changed"), f"verdict {was} to {now}"


def _sure(found: tuple[str, str] | None, old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, str] | None:
    """A change of bias or variance; neither better nor worse where a row remarks that its intervals are doubtful."""
    doubtful = any(isinstance(row.get("reason"), str) and row["reason"] for row in (old, new))
    return ("changed", f"{found[1]}, intervals doubtful") if found and doubtful else found


def _bias(old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, str] | None:
    apart = _apart(old, new, "bias")
    text = f"bias {number(_value(old, 'bias'), 3)} to {number(_value(new, 'bias'), 3)}"
    return None if apart == 0 else ("worse" if apart > 0 else "better", text)


def _variance(old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, str] | None:
    was, now = _value(old, "variance"), _value(new, "variance")
    if not (was > 0 and now > 0) or max(was, now) < EFFECT * min(was, now):
        return None
    if all(math.isfinite(_value(row, f"variance_{end}")) for row in (old, new) for end in ("low", "high")):
        if _apart(old, new, "variance") == 0:
            return None
    elif not _outside_f(now / was, _value(old, "repeats"), _value(new, "repeats")):
        return None
    return ("worse" if now > was else "better"), f"variance {number(was, 3)} to {number(now, 3)}"


def _outside_f(ratio: float, before: float, after: float) -> bool:
    """Whether a ratio of variances from that many repeats is outside 99% of what equal ones give."""
    from scipy.special import fdtri

    low, high = (float(fdtri(after - 1, before - 1, p)) for p in (ALPHA / 2, 1 - ALPHA / 2))
    return not low <= ratio <= high


def _exact(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for name, called in EXACT.items():
        was, now = _value(old, name), _value(new, name)
        if abs(now - was) > ROUNDING and max(was, now) >= EFFECT * min(was, now):
            yield ("worse" if now > was else "better"), f"{called} {number(was, 3)} to {number(now, 3)}"


def _growth(old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[str, str] | None:
    if _apart(old, new, "stretch") == 0:
        return None
    rates = (number(_value(row, "stretch_rate"), 3) for row in (old, new))
    return "changed", f"growth rate {' to '.join(rates)}"


def _time(old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[tuple[str, str] | None, str]:
    """The change of time, and what it was judged by."""
    was, now = _value(old, "time_s"), _value(new, "time_s")
    if not (was > 0 and now > 0):
        return None, ""
    samples = [_samples(row) for row in (old, new)]
    if all(len(some) >= 4 for some in samples):
        from scipy.stats import mannwhitneyu

        judged_by = "calls"
        apart = float(mannwhitneyu(*samples, alternative="two-sided").pvalue) < ALPHA
    else:
        spread = [_value(row, "time_iqr_s") for row in (old, new)]
        if not all(map(math.isfinite, spread)):
            return None, "not compared: no spread is stored"
        judged_by = "interquartile range"
        apart = abs(now - was) > sum(spread) / 2
    if not apart or max(was, now) < EFFECT * min(was, now):
        return None, judged_by
    text = f"time {duration(was)} to {duration(now)} ({now / was:.2g} times)"
    return ("worse" if now > was else "better", text), judged_by


def _samples(row: Mapping[str, Any]) -> np.ndarray:
    found = row.get("time_samples")
    return np.asarray(found, dtype=float) if isinstance(found, list | np.ndarray) else np.empty(0)


def _value(row: Mapping[str, Any], name: str) -> float:
    return float(row.get(name, math.nan))


def _apart(old: Mapping[str, Any], new: Mapping[str, Any], name: str) -> int:
    """1 where the interval of the new value lies above that of the old one, -1 where below, else 0."""
    above = _value(new, f"{name}_low") > _value(old, f"{name}_high")
    below = _value(new, f"{name}_high") < _value(old, f"{name}_low")
    return int(above) - int(below)
