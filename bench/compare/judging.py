"""Judges whether a column of a cell changed by more than the uncertainty of both measurements.

The study names the rule of each column (:class:`bench.experiment.columns.ComparisonRule`):

- ``paired``: the cells of both sides have the same seed and noise, so unchanged code produces the same mean estimate. The
  estimate changed if the mean or the variance differ by more than ROUNDING. It got worse or better if the root mean
  squared error changed by a factor of at least PAIRED, with both sides measured against the reference of *before*.
- ``interval``: the two 95% intervals do not overlap.
- ``spread``: the two 95% intervals do not overlap, and the change is at least EFFECT.
- ``exact``, for columns that are computed without noise: the value changed by a factor of at least EFFECT, and by more
  than ROUNDING.
- ``vector``, for gradients that are computed without noise: it moved by more than ROUNDING of its norm.
- ``verdict``: the verdict moved in the study's order, which lists the worst first.

Times (``time``) are judged by :mod:`bench.compare.timings`, over all cells together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from bench.experiment.columns import COMMON, Column, Columns, ComparisonRule
from bench.measure.statistics import PHYSICS, UNEXPLAINED, is_unexplained
from bench.report.text import number

EFFECT = 1.25
"""Smallest ratio at which a variance or a computed error counts as changed."""
PAIRED = 1.01
"""Smallest ratio at which an error measured with the same noise counts as worse or better, not only as changed."""
ROUNDING = 1e-6
"""Relative change that rounding on another machine may cause over a long rollout."""
NOTES = (
    "Both sides have the same seeds and noise, so unchanged code gives the same estimates. A mean estimate or a variance "
    f"that moved by more than {ROUNDING:g} shows that the code changed. The cell is worse or better if the RMSE about the "
    f"reference of before changed by {PAIRED - 1:.0%} or more, otherwise changed.",
    "A bias is also worse or better if its 95% interval no longer overlaps the one before. A variance is also worse or "
    f"better if it changed by a factor of {EFFECT:g} or more and its interval no longer overlaps.",
    f"Errors computed without noise count if they changed by a factor of {EFFECT:g} or more and by more than {ROUNDING:g}. "
    "Verdicts count by the order that their study gives them. A column for which neither more nor less is better counts "
    "as changed.",
    "A cell that was ok and no longer is, is gone or has lost a judged number is worse. A new cell counts as changed. A bias or variance whose "
    "interval a remark calls doubtful counts as changed, unless the paired RMSE decides.",
    "Rows are of one cell if all their parameters, samples, repeats and seed are equal. A parameter that a stored row lacks "
    "has its present default.",
)

Row = Mapping[str, Any]


class Change(NamedTuple):
    """The change of one column of a cell."""

    outcome: str
    """``worse``, ``better`` or ``changed``."""
    text: str
    """The change in a few words."""
    subject: str = ""
    """The changed column by its name in sentences, or ``no longer ok``, or ``gone`` or ``new`` for a whole cell."""


def judge_cell(columns: Columns, old: Row | None, new: Row | None) -> list[Change]:
    """Return the changes of a cell in its status and in its judged columns, except times; either row may be missing."""
    was, now = ("" if row is None else row["status"] for row in (old, new))
    if old is None or new is None or was != now:
        return [_whole(was, now, _remark(new))]
    if was != "ok":
        return []
    # if the estimates are equal, only the reference can differ, which makes them neither better nor worse
    pairs = (_pair(rule_of(column), old, new) for column in columns.compared)
    are_same, doubt = any(pair and pair.is_same for pair in pairs), _doubt(old, new)
    changes = _lost(columns, old, new)
    for column in columns.compared:
        rule = rule_of(column)
        is_estimated = rule.by in ("interval", "spread")
        change = None if is_estimated and are_same else RULES[rule.by](column, old, new)
        if change:
            outcome = "changed" if rule.neutral or (is_estimated and doubt) else change.outcome
            changes.append(Change(outcome, change.text + doubt * is_estimated, rule.called))
    return changes


def _whole(was: str, now: str, reason: str) -> Change:
    """Return the change of a cell that is new, gone or of another status."""
    outcome = "worse" if was == "ok" else "better" if was and now == "ok" else "changed"
    if not was:
        return Change(outcome, "new", "new")
    if not now:
        return Change(outcome, f"gone, it was {was}", "gone")
    return Change(outcome, f"status {was} to {now}" + f" ({reason})" * bool(reason), "no longer ok")


def _doubt(old: Row, new: Row) -> str:
    """Return what the remarks of both rows say against their intervals; empty if nothing."""
    remarks = [text for row in (old, new) for text in _remark(row).split("; ") if text and not text.startswith(PHYSICS)]
    doubt = f", {UNEXPLAINED}" if any(map(is_unexplained, remarks)) else ", intervals doubtful"
    return doubt * bool(remarks)


def _lost(columns: Columns, old: Row, new: Row) -> list[Change]:
    """Return a change if values are lost that rules use or, in a study without rules, any numbers."""
    judged = [column for column in columns.compared if not column.measured]
    names = [
        name
        for column in judged
        for rule in (rule_of(column),)
        for name in (column.name, *_ends(column), rule.mean, rule.variance, rule.reference)
    ] or [c.name for c in columns.all if c.kind == "number" and not c.measured and c.name not in COMMON]
    lost = [name for name in dict.fromkeys(names) if _n_values(new, name) < _n_values(old, name)]
    return [Change("worse", f"no value any more: {', '.join(lost)}", "no value")] if lost else []


def _n_values(row: Row, name: str) -> int:
    """Return the number of values in a column of a row: of numbers that are not NaN, or 1 for a string."""
    stored = row.get(name)
    if isinstance(stored, str):
        return int(stored != "")
    return int(np.count_nonzero(~np.isnan(np.asarray(stored, dtype=float))))


def _ends(column: Column) -> tuple[str, str]:
    """Return the columns of the ends of a column's 95% interval."""
    return column.low or f"{column.name}_low", column.high or f"{column.name}_high"


def _remark(row: Row | None) -> str:
    """Return the reason of a row; empty if there is none."""
    reason = row.get("reason") if row is not None else ""
    return reason if isinstance(reason, str) else ""


class _Pair(NamedTuple):
    """Mean estimates on the same noise with their variances and references, each as [before, after]."""

    means: list[np.ndarray]
    variances: list[float]
    references: list[np.ndarray]
    scale: float
    """The larger of the two root mean squares of one estimate."""

    @property
    def distance(self) -> float:
        """Euclidean distance between the two means."""
        return float(np.linalg.norm(self.means[1] - self.means[0]))

    @property
    def is_same(self) -> bool:
        """Whether the estimates are equal up to rounding."""
        was, now = map(math.sqrt, self.variances)
        return max(self.distance, abs(now - was)) <= ROUNDING * self.scale


def _pair(rule: ComparisonRule, old: Row, new: Row) -> _Pair | None:
    """Return the stored estimates of two rows of the same noise, or None if a row does not store them."""
    means, references = ([numbers(row, name) for row in (old, new)] for name in (rule.mean, rule.reference))
    variances = [value(row, rule.variance) for row in (old, new)]
    if not means[0].size or not means[0].shape == means[1].shape == references[0].shape:
        return None
    if not np.isfinite([*means[0], *means[1], *references[0], *variances]).all():
        return None
    # hypot does not overflow where squares of exploding gradients would
    scale = max(math.hypot(*mean, math.sqrt(v)) for mean, v in zip(means, variances, strict=True))
    return _Pair(means, variances, references, scale)


def _paired(column: Column, old: Row, new: Row) -> Change | None:
    """Judge an error by the mean estimates on the same noise."""
    rule = rule_of(column)
    pair = _pair(rule, old, new)
    if pair is None:
        return None
    if pair.is_same:
        stem = rule.reference.partition("_")[0]  # of reference_gradient: its standard error is reference_se
        return _reference_change(pair, [value(row, f"{stem}_se") for row in (old, new)])
    was, now = (
        math.hypot(*(mean - pair.references[0]), math.sqrt(v))
        for mean, v in zip(pair.means, pair.variances, strict=True)
    )
    outcome = "changed"
    if max(was, now) >= PAIRED * min(was, now) and abs(now - was) > ROUNDING * pair.scale:
        outcome = "worse" if now > was else "better"
    text = f"{rule.called} {number(was, 3)} to {number(now, 3)} on the same noise"
    norm = math.hypot(*pair.means[0])
    if norm > 0:
        text += f", the mean estimate moved by {number(pair.distance / norm)} of itself"
    return Change(outcome, text)


def _reference_change(pair: _Pair, errors: list[float]) -> Change | None:
    """Return a change if the reference moved by more than both standard errors allow, though the estimates are equal."""
    old, new = pair.references
    if new.shape != old.shape or not np.isfinite(new).all():
        return None
    # four standard errors
    tolerance = 4.0 * math.hypot(*(error if error > 0 else 0.0 for error in errors))
    distance = float(np.linalg.norm(new - old))
    if distance <= tolerance + ROUNDING * float(np.linalg.norm(old)):
        return None
    return Change("changed", f"the same estimates, but the reference moved by {number(distance, 3)}")


def numbers(row: Row, name: str) -> np.ndarray:
    """Return the list of numbers in column ``name`` of a row; an empty array if there is none."""
    stored = row.get(name)
    return np.asarray(stored, dtype=float) if isinstance(stored, list | np.ndarray) else np.empty(0)


def value(row: Row, name: str) -> float:
    """Return the number in column ``name`` of a row; NaN if there is none."""
    return float(row.get(name, math.nan))


def _size(column: Column, old: Row, new: Row) -> Change | None:
    """Judge a number by its interval, by its factor, or by both (``spread``)."""
    rule, was, now = rule_of(column), value(old, column.name), value(new, column.name)
    low, high = _ends(column)
    is_apart = value(new, low) > value(old, high) or value(new, high) < value(old, low)
    is_large = max(was, now) >= EFFECT * min(was, now)
    is_changed = {
        "interval": is_apart,
        "spread": is_apart and is_large and was > 0 and now > 0,
        "exact": is_large and abs(now - was) > ROUNDING,
    }
    text = f"{rule.called} {number(was, 3)} to {number(now, 3)}"
    return Change("worse" if now > was else "better", text) if is_changed[rule.by] else None


def distance(column: Column, old: Row, new: Row) -> float:
    """Return the distance of two rows' vectors relative to the old norm, infinite from 0; NaN where one is missing."""
    was, now = numbers(old, column.name), numbers(new, column.name)
    if not was.size or was.shape != now.shape:
        return math.nan
    norm, moved = math.hypot(*was), math.hypot(*(now - was))
    return moved / norm if norm > 0 else math.inf if moved > 0 else 0.0


def _vector(column: Column, old: Row, new: Row) -> Change | None:
    moved = distance(column, old, new)
    if not moved > ROUNDING:
        return None
    norm = number(math.hypot(*numbers(new, column.name)))
    size = f"by {number(moved)} of its norm" if math.isfinite(moved) else f"from 0 to norm {norm}"
    return Change("changed", f"{rule_of(column).called} moved {size}")


def _verdict(column: Column, old: Row, new: Row) -> Change | None:
    was, now = old.get(column.name, ""), new.get(column.name, "")
    if was == now:
        return None
    rule, outcome = rule_of(column), "changed"
    if was in rule.order and now in rule.order:
        outcome = "worse" if rule.order.index(now) < rule.order.index(was) else "better"
    return Change(outcome, f"{rule.called} {was or 'none'} to {now or 'none'}")


RULES: dict[str, Callable[[Column, Row, Row], Change | None]] = {
    "paired": _paired,
    "interval": _size,
    "spread": _size,
    "exact": _size,
    "vector": _vector,
    "verdict": _verdict,
    "time": lambda *_: None,  # see bench.compare.timings
}


def rule_of(column: Column) -> ComparisonRule:
    """Return the rule of a judged column."""
    assert column.comparison is not None
    return column.comparison
