"""Reads records of the user's own, and evaluates the expressions that name measurements and missing terms."""

from __future__ import annotations

import ast
import itertools
import math
import operator
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from bench.errors import UserError

OFF = 0.01
"""Share of a step by which a time may differ from a multiple of it."""


def hysteresis(x: np.ndarray) -> np.ndarray:
    """Return the force of a spring with dry friction in series along positions ``(n,)``, at most 1."""
    # distance over which the force of hysteresis rises, relative to the largest distance from 0
    slips = np.diff(x) / max(0.1 * float(np.abs(x).max()), 1e-300)
    return np.array([*itertools.accumulate(slips, lambda force, by: np.clip(force + by, -1.0, 1.0), initial=0.0)])


FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "abs": np.abs,
    "cos": np.cos,
    "exp": np.exp,
    "hysteresis": hysteresis,
    "sign": np.sign,
    "sin": np.sin,
    "slope": np.gradient,
    "sqrt": np.sqrt,
    "tanh": np.tanh,
}


OPERATIONS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}


def evaluate(text: str, names: Mapping[str, Any]) -> Any:
    """Return the value of an expression of numbers, pi, ``names``, ``+ - * / **`` and :data:`FUNCTIONS`.

    Raises :class:`UserError` for anything else.

    >>> evaluate("-2 * angle**2", {"angle": 3.0})
    -18.0
    """
    known = {"pi": math.pi, **names}
    try:
        with np.errstate(all="ignore"):
            return 0.0 + _value(ast.parse(text.strip(), mode="eval").body, known)
    except Exception as error:  # of any operation on columns
        allowed = ", ".join(sorted({**FUNCTIONS, **known}))
        raise UserError(f"'{text}': {error} (numbers, operations and {allowed})") from None


def _value(node: ast.expr, names: Mapping[str, Any]) -> Any:
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return float(number)  # a power of integers may have any length
        case ast.Name(id=name) if name in names:
            return names[name]
        case ast.Name(id=name):
            raise ValueError(f"name {name!r} is not defined")
        case ast.UnaryOp(op=operation, operand=operand) if type(operation) in OPERATIONS:
            return OPERATIONS[type(operation)](_value(operand, names))
        case ast.BinOp(left=left, op=operation, right=right) if type(operation) in OPERATIONS:
            return OPERATIONS[type(operation)](_value(left, names), _value(right, names))
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in FUNCTIONS:
            return FUNCTIONS[name](_value(argument, names))
    raise ValueError(f"{ast.unparse(node)} is not arithmetic")


def expressions(text: str | None) -> dict[str, str]:
    """Return expressions by name.

    >>> expressions("{q0: angle*pi/180, v0: rate}")
    {'q0': 'angle*pi/180', 'v0': 'rate'}
    """
    parts = [part.partition(":") for part in (text or "").strip("{ }").split(",") if part.strip()]
    return {name.strip(): expression.strip() for name, _, expression in parts}


def read(
    path: str, columns: Mapping[str, str], time: str | None, dt: float, interpolate: bool
) -> tuple[pd.DataFrame, np.ndarray]:
    """Return the measurements of a CSV file by name, and the steps, from 1, after which they were made.

    ``columns`` are expressions of the file's columns by name; empty: all but that of time. Lines before the first step are
    left out. Raises ValueError with the number of the first line that cannot be used.
    """
    try:
        words = pd.read_csv(
            path, header=None, dtype=str, keep_default_na=False, skip_blank_lines=False, skipinitialspace=True
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}".strip()) from None
    table = words.apply(pd.to_numeric, errors="coerce").add_prefix("c")
    if table.iloc[0].isna().all():
        table = table[1:].set_axis([re.sub(r"\W", "_", name.strip()) for name in words.iloc[0]], axis=1)
    if not time and (found := {"time", "t"} & {*table}):
        raise ValueError(f"{path} has a column of times: write time={found.pop()}")
    columns = columns or {name: name for name in table if name != time}
    values = pd.DataFrame({name: evaluate(text, table) for name, text in columns.items()}, index=table.index)
    times = evaluate(time, table) / dt if time else pd.Series(np.arange(1.0, 1.0 + len(table)), table.index)
    steps, apart = times.round(), math.inf if interpolate else OFF
    faults = {
        "not finite numbers": ~np.isfinite(times + (0.0 if interpolate else values.sum(axis=1, skipna=False))),
        "its time is not later than that before": times.diff() <= 0.0,
        f"its time is not a multiple of dt={dt:g}; interpolate=true resamples": (times - steps).abs() > apart,
    }
    for fault, lines in faults.items():
        if lines.any():
            line = lines.idxmax()
            raise ValueError(f"{path}, line {line + 1} ({', '.join(words.loc[line])}): {fault}")
    if interpolate:
        steps = np.arange(np.ceil(times.iloc[0] - OFF), times.iloc[-1] + OFF)
        known = values.map(np.isfinite)
        values = pd.DataFrame(
            {name: np.interp(steps, times[known[name]], values[name][known[name]]) for name in values}
        )
    values, steps = values[steps > 0.0], np.asarray(steps)[steps > 0.0].astype(int)
    for name, column in values.items():
        if len(column) > 1 and column.nunique() == 1:
            raise ValueError(f"{path}: {columns[name]} is constant")
    return values, steps
