"""Judges whether a column of a cell changed by more than the uncertainty of both measurements.

The study says how a column is judged (:class:`bench.experiment.columns.ComparisonRule`):

- ``paired``: the cells of both sides have the same seed and noise, so unchanged code gives the same mean estimate. It
  moved where the mean or the variance differ by more than ROUNDING. It got worse or better where the root mean squared
  error changed by a factor of PAIRED at least, with both sides' errors measured against the reference of *before*.
- ``interval``: the two 95% intervals are apart.
- ``spread``: the two 95% intervals are apart where both are stored, else the ratio leaves the central 99% of an F
  distribution with R - 1 degrees of freedom on both sides (normal estimates with one dominant component, the fewest
  possible). In either case the change must also be at least EFFECT.
- ``exact``, computed and not estimated: it changed by EFFECT at least, and by more than ROUNDING of what it is relative
  to.
- ``verdict``: it moved in the study's order, which is worst first.

Times (``time``) are judged by :mod:`bench.compare.timings`, over all cells together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from bench.experiment.columns import Column, Columns, ComparisonRule
from bench.measure.statistics import UNEXPLAINED, is_unexplained
from bench.report.text import number

EFFECT = 1.25
"""Ratio below which neither a variance nor a computed error counts as changed."""
PAIRED = 1.01
"""Ratio below which an error measured with the same noise counts as neither worse nor better, only as changed."""
ALPHA = 0.01
ROUNDING = 1e-6
"""Relative change that the rounding of another machine may cause through a long rollout."""
SIGMAS = 4.0
"""Standard errors between two references beyond which the reference itself moved."""
NOTES = (
    "Both sides have the same seeds and noise, so unchanged code gives the same estimates. A mean estimate or a variance "
    f"that moved by more than {ROUNDING:g} is a change of the code: worse or better where the RMSE about the reference of "
    f"before changed by {PAIRED - 1:.0%} or more, else changed.",
    "Also worse or better: a bias whose 95% interval no longer overlaps the one before; a variance whose interval "
    "no longer overlaps either (or, where no interval is stored, that is outside 99% of an F test) and that changed by a "
    f"factor of {EFFECT:g} or more.",
    f"Errors computed without noise count where they changed by a factor of {EFFECT:g} or more and by more than {ROUNDING:g}. "
    "Verdicts count by the order that their study gives them. Where neither more nor less is better, a "
    "change counts as changed, neither worse nor better.",
    "A cell that was ok and no longer is, or is gone, is worse. New cells are neither. A bias or variance whose interval a "
    "remark calls doubtful is changed, neither worse nor better, unless the paired RMSE decides.",
)

Row = Mapping[str, Any]


class Change(NamedTuple):
    """What became of one column: ``worse``, ``better`` or ``changed``, and a few words."""

    outcome: str
    text: str


def judge(column: Column, columns: Columns, old: Row, new: Row) -> Change | None:
    """Return the change of one judged column between two rows that both ended well, or None."""
    assert column.comparison is not None
    change = RULES[column.comparison.by](column, columns, old, new)
    if change is None:
        return None
    if column.comparison.neutral:
        change = change._replace(outcome="changed")
    remarks = [str(row["reason"]) for row in (old, new) if isinstance(row.get("reason"), str) and row["reason"]]
    if remarks and column.comparison.by in ("interval", "spread"):
        doubt = UNEXPLAINED if any(map(is_unexplained, remarks)) else "intervals doubtful"
        return Change("changed", f"{change.text}, {doubt}")
    return change


class _Pair(NamedTuple):
    """Two mean estimates on the same noise, with variances and references; each before and after."""

    means: list[np.ndarray]
    variances: list[float]
    references: list[np.ndarray]
    scale: float
    """The larger root mean square of one estimate."""

    @property
    def moved(self) -> float:
        """Distance between the two means."""
        return float(np.linalg.norm(self.means[1] - self.means[0]))

    @property
    def same(self) -> bool:
        """Whether the estimates are the same, up to rounding."""
        was, now = map(math.sqrt, self.variances)
        return max(self.moved, abs(now - was)) <= ROUNDING * self.scale


def _pair(judged: ComparisonRule, old: Row, new: Row) -> _Pair | None:
    """Return what two rows of the same noise store, or None where a side does not."""
    if judged.by != "paired":
        return None
    means, references = ([_list(row, name) for row in (old, new)] for name in (judged.mean, judged.reference))
    variances = [value(row, judged.variance) for row in (old, new)]
    if not means[0].size or not means[0].shape == means[1].shape == references[0].shape:
        return None
    if not np.isfinite([*means[0], *means[1], *references[0], *variances]).all():
        return None
    # hypot, since the squares of exploding gradients overflow
    scale = max(math.hypot(*mean, math.sqrt(v)) for mean, v in zip(means, variances, strict=True))
    return _Pair(means, variances, references, scale)


def same_estimates(column: Column, old: Row, new: Row) -> bool:
    """Return whether a paired column has the same estimates on both sides; False where they are not stored."""
    pair = _pair(_judged(column), old, new)
    return pair is not None and pair.same


def _paired(column: Column, columns: Columns, old: Row, new: Row) -> Change | None:
    """Judge an error by the mean estimates on the same noise; None where a side does not store them."""
    judged = _judged(column)
    pair = _pair(judged, old, new)
    if pair is None:
        return None
    if pair.same:
        return _other_reference(pair, [value(row, f"{_stem(judged.reference)}_se") for row in (old, new)])
    was, now = (
        math.hypot(*(mean - pair.references[0]), math.sqrt(v))
        for mean, v in zip(pair.means, pair.variances, strict=True)
    )
    outcome = "changed"
    if max(was, now) >= PAIRED * min(was, now) and abs(now - was) > ROUNDING * pair.scale:
        outcome = "worse" if now > was else "better"
    text = f"{judged.called} {number(was, 3)} to {number(now, 3)} on the same noise"
    norm = math.hypot(*pair.means[0])
    if norm > 0:
        text += f", the mean estimate moved by {number(pair.moved / norm)} of itself"
    return Change(outcome, text)


def _other_reference(pair: _Pair, errors: list[float]) -> Change | None:
    """Return a change where the estimates are the same and the reference is not, beyond both standard errors."""
    old, new = pair.references
    if new.shape != old.shape or not np.isfinite(new).all():
        return None
    uncertain = SIGMAS * math.hypot(*(error if error > 0 else 0.0 for error in errors))
    apart = float(np.linalg.norm(new - old))
    if apart <= uncertain + ROUNDING * float(np.linalg.norm(old)):
        return None
    return Change("changed", f"the same estimates, but the reference moved by {number(apart, 3)}")


def _stem(reference: str) -> str:
    """Return the prefix of the columns beside a reference: ``reference`` of ``reference_gradient``."""
    return reference.partition("_")[0]


def _list(row: Row, name: str) -> np.ndarray:
    numbers = row.get(name)
    return np.asarray(numbers, dtype=float) if isinstance(numbers, list | np.ndarray) else np.empty(0)


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
    "paired": _paired, "interval": _interval, "spread": _spread, "exact": _exact, "verdict": _verdict,
}  # fmt: skip


def _judged(column: Column) -> ComparisonRule:
    assert column.comparison is not None
    return column.comparison


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
