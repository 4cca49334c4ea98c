"""Judges whether a column of a cell changed by more than the uncertainty of both measurements.

The study says how a column is judged (:class:`bench.sweep.columns.Judged`):

- ``interval``: the two 95% intervals are apart.
- ``spread``: the two 95% intervals are apart where both are stored, else the ratio leaves the central 99% of an F
  distribution with R - 1 degrees of freedom on both sides (normal estimates with one dominant component, the fewest
  possible). In either case the change must also be at least EFFECT.
- ``exact``, computed and not estimated: it changed by EFFECT at least, and by more than ROUNDING of what it is relative
  to.
- ``time``: the medians differ by EFFECT at least and, of the stored times of single calls, a two-sided Mann-Whitney
  test (Mann and Whitney 1947) has p < ALPHA; without those, the middle halves of the calls (median and half its
  interquartile range on each side) are apart.
- ``verdict``: it moved in the study's order, which is worst first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from bench.report.text import duration, number
from bench.sweep.columns import Column, Columns, Judged

EFFECT = 1.25
"""Ratio below which neither a variance, a computed error nor a time counts as changed."""
ALPHA = 0.01
ROUNDING = 1e-6
"""Change of a computed error that the rounding of another machine may cause through a long rollout."""
NOTES = (
    "worse, better: an estimated error whose 95% interval no longer overlaps the one before; a variance whose interval "
    "no longer overlaps either (or, where no interval is stored, that is outside 99% of an F test) and that changed by a "
    f"factor of {EFFECT:g} or more; "
    f"a time that changed by a factor of {EFFECT:g} or more with p < {ALPHA:g} in a Mann-Whitney test of the single calls "
    "(or, without them, with interquartile ranges that do not overlap).",
    f"Errors computed without noise count where they changed by a factor of {EFFECT:g} or more and by more than {ROUNDING:g}. "
    "Verdicts count by the order that their study gives them. Where neither more nor less is better, a "
    "change counts as changed, neither worse nor better.",
    "A cell that was ok and no longer is, or is gone, is worse. New cells are neither, nor are cells whose intervals a remark "
    "calls doubtful.",
    f"Each cell is judged by itself: of cells that did not change, up to {ALPHA:.0%} may be reported as changed by chance.",
)

Row = Mapping[str, Any]


class Change(NamedTuple):
    """What became of one column: ``worse``, ``better`` or ``changed``, and a few words."""

    outcome: str
    text: str


def judge(column: Column, columns: Columns, old: Row, new: Row) -> Change | None:
    """Return the change of one judged column between two rows that both ended well, or None."""
    assert column.judged is not None
    change = RULES[column.judged.by](column, columns, old, new)
    if change is None:
        return None
    if column.judged.neutral:
        change = change._replace(outcome="changed")
    doubtful = any(isinstance(row.get("reason"), str) and row["reason"] for row in (old, new))
    if doubtful and column.judged.by in ("interval", "spread"):
        return Change("changed", f"{change.text}, intervals doubtful")
    return change


def time_basis(column: Column, old: Row, new: Row) -> str:
    """Return what a time is judged by: ``calls``, ``interquartile range``, or why it is not; nothing without times."""
    if not (value(old, column.name) > 0 and value(new, column.name) > 0):
        return ""
    if all(len(_calls(column, row)) >= 4 for row in (old, new)):
        return "calls"
    spreads = (value(row, f"{_stem(column)}_iqr_s") for row in (old, new))
    return "interquartile range" if all(map(math.isfinite, spreads)) else "not compared: no spread is stored"


def _interval(column: Column, columns: Columns, old: Row, new: Row) -> Change | None:
    return _by_size(column, old, new) if _apart(column, columns, old, new) else None


def _spread(column: Column, columns: Columns, old: Row, new: Row) -> Change | None:
    was, now = value(old, column.name), value(new, column.name)
    if not (was > 0 and now > 0) or max(was, now) < EFFECT * min(was, now):
        return None
    ends = [value(row, name) for row in (old, new) for name in _ends(column, columns)]
    if all(map(math.isfinite, ends)):
        changed = _apart(column, columns, old, new)
    else:
        changed = outside_f(now / was, value(old, "repeats"), value(new, "repeats"))
    return _by_size(column, old, new) if changed else None


def outside_f(ratio: float, before: float, after: float) -> bool:
    """Return whether a ratio of variances from that many repeats is outside 99% of the ratios of equal variances."""
    from scipy.special import fdtri

    low, high = (float(fdtri(after - 1, before - 1, p)) for p in (ALPHA / 2, 1 - ALPHA / 2))
    return not low <= ratio <= high


def _exact(column: Column, columns: Columns, old: Row, new: Row) -> Change | None:
    was, now = value(old, column.name), value(new, column.name)
    changed = abs(now - was) > ROUNDING and max(was, now) >= EFFECT * min(was, now)
    return _by_size(column, old, new) if changed else None


def _time(column: Column, columns: Columns, old: Row, new: Row) -> Change | None:
    was, now = value(old, column.name), value(new, column.name)
    basis = time_basis(column, old, new)
    if basis == "calls":
        from scipy.stats import mannwhitneyu

        calls = [_calls(column, row) for row in (old, new)]
        apart = float(mannwhitneyu(*calls, alternative="two-sided").pvalue) < ALPHA
    elif basis == "interquartile range":
        apart = abs(now - was) > sum(value(row, f"{_stem(column)}_iqr_s") for row in (old, new)) / 2
    else:
        return None
    if not apart or max(was, now) < EFFECT * min(was, now):
        return None
    text = f"{_judged(column).called} {duration(was)} to {duration(now)} ({now / was:.2g} times)"
    return Change("worse" if now > was else "better", text)


def _verdict(column: Column, columns: Columns, old: Row, new: Row) -> Change | None:
    was, now = old.get(column.name, ""), new.get(column.name, "")
    if was == now:
        return None
    judged = _judged(column)
    if was in judged.order and now in judged.order:
        outcome = "worse" if judged.order.index(now) < judged.order.index(was) else "better"
    else:
        outcome = "changed"
    return Change(outcome, f"{judged.called} {was or 'none'} to {now or 'none'}")


RULES: dict[str, Callable[[Column, Columns, Row, Row], Change | None]] = {
    "interval": _interval, "spread": _spread, "exact": _exact, "time": _time, "verdict": _verdict,
}  # fmt: skip


def _judged(column: Column) -> Judged:
    assert column.judged is not None
    return column.judged


def _by_size(column: Column, old: Row, new: Row) -> Change:
    was, now = value(old, column.name), value(new, column.name)
    text = f"{_judged(column).called} {number(was, 3)} to {number(now, 3)}"
    return Change("worse" if now > was else "better", text)


def value(row: Row, name: str) -> float:
    """Return a number of a row; NaN where it has none."""
    return float(row.get(name, math.nan))


def _ends(column: Column, columns: Columns) -> tuple[str, str]:
    """Return the columns of an interval: ``bias_low``, or ``stretch_low`` of ``stretch_rate`` if there is no other."""
    stem = column.name if f"{column.name}_low" in columns.by_name else column.name.rpartition("_")[0]
    return f"{stem}_low", f"{stem}_high"


def _apart(column: Column, columns: Columns, old: Row, new: Row) -> bool:
    low, high = _ends(column, columns)
    return value(new, low) > value(old, high) or value(new, high) < value(old, low)


def _stem(column: Column) -> str:
    """Return the prefix of the columns beside a time: ``time`` of ``time_s``."""
    return column.name.removesuffix("_s")


def _calls(column: Column, row: Row) -> np.ndarray:
    seconds = row.get(f"{_stem(column)}_samples")
    return np.asarray(seconds, dtype=float) if isinstance(seconds, list | np.ndarray) else np.empty(0)
