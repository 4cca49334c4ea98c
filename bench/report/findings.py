"""What follows from rows of estimates: at each setting the estimators of lowest error, and where along an axis."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from bench.grid import Experiment
from bench.report.views import Family, Line, along, axis_value, families, numeric_axes, ran

TIE = 1.1
"""Relative RMSEs within this factor of the lowest share the first place: R repeats do not resolve less."""


def problems(
    experiment: Experiment, rows: pd.DataFrame, axes: Sequence[str], smoothing: Mapping[str, str] | None = None
) -> list[tuple[str | None, Family]]:
    """The problems to tell of, each along the longest axis that it was swept along; every cell that ran is in one."""
    found = numeric_axes(experiment, rows, axes)
    parts: list[tuple[str | None, Family]] = []
    seen: set[str] = set()
    for axis in (*sorted(found, key=lambda a: -found[a]), None):
        for group in families(along(rows, axis, experiment), ("scene", "contact"), smoothing):
            cells = ran(group.rows)
            if set(cells["key"]) - seen and (axis is None or cells["x"].nunique() > 1):
                seen |= set(cells["key"])
                parts.append((axis, group))
    return parts


def lowest(found: Sequence[Line]) -> dict[float, float]:
    """The lowest relative RMSE at each ``x`` where there is one, in increasing order."""
    rows = pd.concat([line.rows for line in found])
    good = rows[(rows["status"] == "ok") & np.isfinite(rows["rmse_rel"])]
    return good.groupby(level=0)["rmse_rel"].min().to_dict()


def winners(found: Sequence[Line]) -> dict[float, list[str]]:
    """At each ``x`` the estimators whose error is lowest or not told from it."""
    named = {}
    for x, low in lowest(found).items():
        good = [line for line in found if x in line.at and line.at[x]["status"] == "ok"]
        named[x] = list(dict.fromkeys(line.label for line in good if line.at[x]["rmse_rel"] <= TIE * low))
    return named


def span(where: Mapping[float, bool]) -> str:
    """Where a finding holds along an axis: nothing for everywhere, ``<=1000``, ``>=1e4``, ``at 10 and 100..3000``."""
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
