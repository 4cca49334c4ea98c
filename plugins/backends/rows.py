"""Evaluates JAX code row by row: an array ``(n, B)`` with few rows becomes a tuple of n arrays ``(B,)``.

Model code stacks and slices rows, and XLA compiles a stack to a loop that checks the row of each element. Row by row,
the same operations are long loops without branches, which vectorise. Results are identical, since each element is
computed by the same operations in the same order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bench.model import Array

from ..jaxprs import FOLD, interpret

MAX_ROWS = 16
"""Maximum number of rows of arrays that are split."""
ELEMENTWISE = FOLD.keys() - {"stop_gradient"} | {"cbrt", "convert_element_type", "exp2", "integer_pow", "round"}
"""Primitives that compute each element only from the elements at the same position."""


def split(array: Array, axis: int = 0) -> Any:
    """Return the rows of a ``(n, B)`` array, or of ``(T, n, B)`` with axis 1; return any other array unchanged."""
    if array.ndim != axis + 2 or not 0 < array.shape[axis] <= MAX_ROWS:
        return array
    return tuple(array[(slice(None),) * axis + (i,)] for i in range(array.shape[axis]))


def join(value: Any) -> Array:
    """Return a tuple of rows stacked to an array ``(n, B)``; return an array unchanged."""
    import jax.numpy as jnp

    return jnp.stack(value) if isinstance(value, tuple) else value


def evaluate(jaxpr: Any, consts: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
    """Return the outputs of a jaxpr for arguments split into rows; ``(n, B)`` outputs with few rows are split too."""
    values = interpret(jaxpr, consts, arguments, _apply)
    return [split(value) if hasattr(value, "ndim") else value for value in values]


def _apply(equation: Any, values: list[Any]) -> list[Any]:
    """Return the outputs of one equation of a jaxpr, split into rows if possible."""
    name, parameters, primitive = equation.primitive.name, equation.params, equation.primitive
    out = equation.outvars[0].aval
    if name in ("jit", "pjit"):
        return evaluate(parameters["jaxpr"].jaxpr, parameters["jaxpr"].consts, values)
    if name == "unstack" and parameters["axis"] == 0 and isinstance(values[0], tuple):  # since JAX 0.11
        return list(values[0])
    rows = None
    if any(isinstance(value, tuple) for value in values) or name == "stack":
        rows = _rows(name, parameters, primitive, values, out)
    if rows is not None:
        return [rows]
    result = primitive.bind(*map(join, values), **primitive.get_bind_params(parameters))
    return list(result) if primitive.multiple_results else [result]


def _rows(name: str, parameters: Any, primitive: Any, values: list[Any], out: Any) -> Any:
    """Return the output as rows, or as one row ``(B,)``; None if the operation has no row-wise form."""
    if name == "squeeze" and parameters["dimensions"] == (0,):
        return values[0][0]
    if out.ndim != 2 or not 0 < out.shape[0] <= MAX_ROWS:
        return None
    if name in ELEMENTWISE:
        columns = [_repeated(value, out.shape[0]) for value in values]
        return tuple(primitive.bind(*row, **parameters) for row in zip(*columns, strict=True))
    if name == "stack" and parameters["axis"] == 0:
        return tuple(values)
    if name == "concatenate" and parameters["dimension"] == 0:
        return tuple(row for value in values for row in (value if isinstance(value, tuple) else split(value)))
    if name == "slice" and parameters["strides"] is None and values[0][0].shape == out.shape[1:]:
        return values[0][parameters["start_indices"][0] : parameters["limit_indices"][0]]
    return None


def _repeated(value: Any, count: int) -> tuple[Any, ...]:
    """Return the operand for each of ``count`` rows: the row itself, or a single row or number repeated."""
    if getattr(value, "ndim", 0) == 2:
        value = split(value)
    rows = value if isinstance(value, tuple) else (value,)
    return rows if len(rows) == count else rows * count
