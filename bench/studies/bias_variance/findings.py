"""Findings from rows of estimates: at each setting the estimators of lowest error, and where along an axis."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from bench.report.text import axis_value
from bench.report.views import Arranged, Family, Line, along, families, ran
from bench.sweep.axes import Axis

TIE = 1.1
"""Relative RMSEs within this factor of the lowest share the first place: R repeats do not resolve less."""


def problems(shown: Arranged) -> list[tuple[Axis | None, Family]]:
    """Return the problems to report, each along the longest axis it was swept along; every cell that ran is in one."""
    swept = shown.swept()
    parts: list[tuple[Axis | None, Family]] = []
    seen: set[str] = set()
    for axis in (*sorted(swept, key=lambda a: -swept[a]), None):
        for group in families(shown, along(shown, axis), ("scene", "contact")):
            cells = ran(group.rows)
            if set(cells["key"]) - seen and (axis is None or cells["x"].nunique() > 1):
                seen |= set(cells["key"])
                parts.append((axis, group))
    return parts


def lowest(curves: Sequence[Line]) -> dict[float, float]:
    """Return the lowest relative RMSE at each ``x`` where there is one, in increasing order."""
    rows = pd.concat([line.rows for line in curves])
    good = rows[(rows["status"] == "ok") & np.isfinite(rows["rmse_rel"])]
    return good.groupby(level=0)["rmse_rel"].min().to_dict()


def winners(curves: Sequence[Line]) -> dict[float, list[str]]:
    """Return, at each ``x``, the estimators whose error is lowest or not distinguishable from the lowest."""
    named = {}
    for x, low in lowest(curves).items():
        good = [line for line in curves if x in line.at and line.at[x]["status"] == "ok"]
        named[x] = list(dict.fromkeys(line.label for line in good if line.at[x]["rmse_rel"] <= TIE * low))
    return named


def span(where: Mapping[float, bool]) -> str:
    """Write where a finding holds on an axis: nothing (everywhere), ``<=1000``, ``>=1e4``, ``at 10 and 100..3000``."""
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
