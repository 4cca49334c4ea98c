"""Compares stored rows to the last bit, from files of any kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

WHERE = ("stored_at", "sequence", "wall_s")
"""Columns that record when and how fast a row was computed, which differ between runs."""


def bits(value: Any) -> Any:
    """Return a value as exact strings (hexadecimal for numbers), ``missing`` for None and NaN; lists by element."""
    if isinstance(value, np.ndarray | list | tuple):
        return [bits(one) for one in value]
    if value is None or value != value:
        return "missing"
    return float(value).hex() if isinstance(value, int | float | np.number) else str(value)


def by_key(rows: pd.DataFrame, without: tuple[str, ...] = WHERE) -> dict[str, dict[str, Any]]:
    """Return the exact values of each row by key and column; raises ValueError if a key has two rows."""
    if not rows["key"].is_unique:
        raise ValueError("two rows of one key")
    names = [name for name in rows if name not in without]
    return {row["key"]: {name: bits(row[name]) for name in names} for row in rows.to_dict("records")}


def differences(rows: Mapping[str, Mapping[str, Any]], truth: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a line per value in which ``rows`` differ from ``truth``; rows missing from ``rows`` are not reported."""
    lines = []
    for key, row in rows.items():
        right = truth.get(key)
        if right is None:
            lines.append(f"{key[:8]} is not among the right ones")
        else:
            names = [name for name in {**right, **row} if right.get(name, "no column") != row.get(name, "no column")]
            lines += [f"{key[:8]} {name}: {right.get(name)!r} became {row.get(name)!r}" for name in names]
    return lines
