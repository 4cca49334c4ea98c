"""Finds the estimators with the lowest error at each setting, and where along an axis estimators fail."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
import pandas as pd

from bench.experiment.axes import Axis
from bench.report.problems import ProblemRows, split_by_problem
from bench.report.text import axis_value, number
from bench.report.views import Arranged, Curve, attempted

TIE = 1.1
"""Estimators within this factor of the lowest relative RMSE share first place: R repeats do not resolve less."""
FLAT = 1.5
"""Largest factor between errors along an axis at which the axis counts as having no effect."""
NAMED = 2
"""Most problems that a title names individually."""


def problems_by_axis(shown: Arranged) -> list[tuple[Axis | None, ProblemRows]]:
    """Return the problems to report, each with the longest axis along which it was swept.

    Every cell that ran is in at least one problem. The axis is None for cells that no axis sweeps.
    """
    swept = shown.swept()
    parts: list[tuple[Axis | None, ProblemRows]] = []
    seen: set[str] = set()
    for axis in (*sorted(swept, key=lambda a: -swept[a]), None):
        for group in split_by_problem(shown, axis, ("scene", "contact")):
            cells = attempted(group.rows)
            if set(cells["key"]) - seen and (axis is None or cells["x"].nunique() > 1):
                seen |= set(cells["key"])
                parts.append((axis, group))
    return parts


def lowest(curves: Sequence[Curve], error: str = "rmse_rel") -> dict[float, float]:
    """Return the lowest finite error at each ``x``, in increasing order of ``x``."""
    rows = pd.concat([line.rows for line in curves])
    good = rows[(rows["status"] == "ok") & np.isfinite(rows[error])]
    return {float(x): float(low) for x, low in good.groupby(level=0)[error].min().items()}


def winners(curves: Sequence[Curve], error: str = "rmse_rel") -> dict[float, list[str]]:
    """Return, at each ``x``, the estimators whose error is within a factor :data:`TIE` of the lowest.

    ``error`` is a column: ``rmse_rel`` compares at equal samples, the columns of
    :func:`~.costs.with_errors_at_equal_cost` at equal cost.
    """
    named = {}
    for x, low in lowest(curves, error).items():
        good = [line for line in curves if x in line.at and line.at[x]["status"] == "ok"]
        named[x] = list(dict.fromkeys(line.label for line in good if line.at[x][error] <= TIE * low))
    return named


def span(where: Mapping[float, bool]) -> str:
    """Format where a finding holds on an axis: ``<=1000``, ``>=1e4``, ``at 10 and 100..3000``; empty if everywhere."""
    if all(where.values()):
        return ""
    values = list(where)
    runs = [[x for x, _ in run] for holds, run in itertools.groupby(where.items(), lambda item: item[1]) if holds]
    if len(runs) == 1 and len(runs[0]) > 1:
        if runs[0][0] == values[0]:
            return f"<={axis_value(runs[0][-1])}"
        if runs[0][-1] == values[-1]:
            return f">={axis_value(runs[0][0])}"
    texts = [axis_value(r[0]) if len(r) == 1 else f"{axis_value(r[0])}..{axis_value(r[-1])}" for r in runs]
    return f"at {' and '.join(texts)}"


def headline(
    parts: Sequence[tuple[ProblemRows, Sequence[Curve]]], axis: Axis, marks: Mapping[str, float] = MappingProxyType({})
) -> str:
    """Summarise failures along an axis: where the most frequently best estimator fails, and which estimators never fail.

    An estimator fails where it is no better than the zero estimate, or where its cell has no result. ``marks`` are
    named values of the axis.
    """
    names = _by_wins(parts)
    bad = {name: [_failures(curves, name) for _, curves in parts] for name in names}
    names = [name for name in names if any(bad[name])]
    sound = [name for name in names if not any(any(where.values()) for where in bad[name])]
    useless = [name for name in names if all(all(where.values()) for where in bad[name])]
    broken = [name for name in names if name not in (*sound, *useless)]
    problems = [problem for problem, _ in parts]
    clauses = [f"{broken[0]} fails {_failure_range(bad[broken[0]], problems, axis, marks)}"] if broken else []
    change = max((_error_ratio(line) for _, curves in parts for line in curves), default=math.inf)
    flat = not broken and change < FLAT
    if flat:
        clauses.append(f"{axis.column} changes no error by more than a factor of {number(change)}")
    if useless and not broken:
        clauses.append(f"{' and '.join(useless[:2])} no better than zero")
    if sound and not flat:
        clauses.append(f"{' and '.join(sound[:2])} better than zero everywhere")
    return "; ".join(clauses) or f"No estimator is better than zero anywhere along {axis.column}"


def failure_summary(parts: Sequence[tuple[ProblemRows, Sequence[Curve]]]) -> str:
    """Summarise failures: how often the most frequently best estimator fails, and how many estimators never fail.

    The criterion of failure is the same as in :func:`headline`.
    """
    names = _by_wins(parts)
    failed = {
        name: [any(where.values()) for _, curves in parts if (where := _failures(curves, name))] for name in names
    }
    broken = [name for name in names if any(failed[name])]
    sound = sum(bool(tried) and not any(tried) for tried in failed.values())
    if not broken:
        return "Every estimator is better than the zero estimate on every problem that it was run on"
    first, tried = broken[0], failed[broken[0]]
    if len(parts) == 1:
        return f"{first} fails; {sound or 'none'} of {len(names)} estimators {'is' if sound == 1 else 'are'} better than zero"
    among = f"{sum(tried)} of {len(tried)} problem{'s' * (len(tried) > 1)}"
    return f"{first} fails on {among}; {sound or 'none'} of {len(names)} estimators fail{'s' * (sound == 1)} on none"


def _by_wins(parts: Sequence[tuple[ProblemRows, Sequence[Curve]]]) -> list[str]:
    """Return the estimators, ordered by how often each is best, most often first."""
    wins = Counter(label for _, curves in parts for labels in winners(curves).values() for label in labels)
    return sorted(dict.fromkeys(line.label for _, curves in parts for line in curves), key=lambda name: -wins[name])


def _error_ratio(line: Curve) -> float:
    """Return the ratio of a curve's largest to its smallest error; 1 if it has fewer than two errors."""
    rows = line.rows[line.rows["status"] == "ok"]
    errors = rows.loc[np.isfinite(rows["rmse_rel"]), "rmse_rel"]
    return float(errors.max() / errors.min()) if len(errors) > 1 and errors.min() > 0 else 1.0


def _failures(curves: Sequence[Curve], name: str) -> dict[float, bool]:
    """Return, for each ``x`` at which an estimator ran, whether it failed on any backend; refused cells are omitted."""
    where: dict[float, bool] = {}
    for line in curves:
        for x, row in line.at.items() if line.label == name else ():
            if row["status"] != "ok" or np.isfinite(row["rmse_rel"]):
                where[x] = where.get(x, False) or row["status"] != "ok" or row["rmse_rel"] >= 1
    return dict(sorted(where.items()))


def _range_text(where: str, axis: Axis) -> str:
    """Format a :func:`span` in words: ``from stiffness 1e4``, ``everywhere``."""
    sign = "from" if where.startswith(">=") else "up to" if where.startswith("<=") else "at"
    return f"{sign} {axis.column} {where.removeprefix('at ').lstrip('<>=')}" if where else "everywhere"


def _failure_range(
    bad: Sequence[Mapping[float, bool]], problems: Sequence[ProblemRows], axis: Axis, marks: Mapping[str, float]
) -> str:
    """Format where along an axis an estimator fails, and in which problems; ``bad`` has its failures by problem."""
    failing = [i for i, where in enumerate(bad) if any(where.values())]
    spans = list(dict.fromkeys(span(bad[i]) for i in failing))
    text = _range_text(spans[0], axis) if len(spans) == 1 and spans[0] else ""
    ends = [
        (max((x for x, b in bad[i].items() if not b), default=0.0), min(x for x, b in bad[i].items() if b))
        for i in failing
    ]
    beyond = [name for name, value in marks.items() if all(good <= value < first for good, first in ends)]
    if beyond:
        text = f"beyond the {beyond[0]} ({axis.column} {axis_value(marks[beyond[0]])})"
    for key in ("scene", "contact", "integrator"):
        mine = {str(problems[i].identity.get(key, "")) for i in failing}
        others = {str(f.identity.get(key, "")) for i, f in enumerate(problems) if i not in failing and bad[i]}
        if others and not mine & others and not {"", "none"} & (mine | others):
            return f"{text} with {' and '.join(sorted(mine))}, not with {' and '.join(sorted(others))}".strip()
    n_run = sum(map(bool, bad))
    if not beyond and len(failing) < n_run and len(failing) <= NAMED:
        return " and ".join(f"{_range_text(span(bad[i]), axis)} on {problems[i].title()}" for i in failing)
    if not text and len(spans) == 1:
        text = "everywhere"
    where = "" if len(failing) == n_run else f" in {len(failing)} of {n_run} problems"
    return (text + where).strip() or "at some values"
