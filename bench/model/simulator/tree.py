"""Theta of any shape as one vector: numbers, arrays, and nested dicts, lists, tuples and dataclasses of them.

Each number has a name by its place: ``mass``, ``gains[3]``, ``legs[0].stiffness``.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.errors import UserError

ROUNDED = 1e-14
"""Size of a number, relative to its array, that is a 0 which rounding has left."""
MOST = 100_000
"""Numbers of a theta at most: some thousand thetas are held at once."""


@dataclass(frozen=True)
class Leaf:
    """One array of theta: where it stands in the vector, and what it was given as."""

    path: str
    shape: tuple[int, ...]
    start: int
    library: str
    """``numpy``, ``jax``, ``torch``, or ``number`` for a plain Python number."""
    dtype: str
    """Its floating-point type."""

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return int(np.prod(self.shape, dtype=int))

    def names(self) -> list[str]:
        """Return a name for each of its numbers."""
        path = self.path or "theta"
        if not self.shape:
            return [path]
        return [f"{path}[{','.join(map(str, at))}]" for at in itertools.product(*map(range, self.shape))]


class ParameterTree:
    """How a theta is taken apart into a vector ``(d,)``, and put together again.

    Raises :class:`UserError` for a theta without numbers, or with something that is no number.
    """

    def __init__(self, theta: Any) -> None:
        self._example = theta
        self.leaves: list[Leaf] = []
        values = []
        start = 0
        for path, value in _walk(theta, ""):
            array = as_numpy(value)
            if array.dtype.kind not in "fiu":
                raise UserError(f"{path or 'theta'} is of type {array.dtype}: theta is made of real numbers")
            dtype = str(array.dtype) if array.dtype.kind == "f" else "float64"
            self.leaves.append(Leaf(path, array.shape, start, _library(value), dtype))
            values.append(array.astype(np.float64).ravel())
            start += array.size
        if not start:
            raise UserError("theta has no numbers: give an array, or a dict of arrays, theta={'mass': 1.0}")
        self.vector = np.concatenate(values)
        if start > MOST:
            raise UserError(
                f"theta has {start:,} numbers; up to {MOST:,} can be examined: give fewer, or a part of them"
            )
        if not np.isfinite(self.vector).all():
            bad = self.names[int(np.argmin(np.isfinite(self.vector)))]
            raise UserError(f"{bad} is not finite: give a theta of finite numbers")

    @property
    def names(self) -> list[str]:
        """A name for each number, ``d`` in all."""
        return [name for leaf in self.leaves for name in leaf.names()]

    @property
    def flat(self) -> bool:
        """Whether theta is a single vector ``(d,)`` itself."""
        return len(self.leaves) == 1 and len(self.leaves[0].shape) == 1 and not self.leaves[0].path

    def scales(self) -> np.ndarray:
        """Return the scale of each number: its own size; for 0, that of its array; else 1."""
        scale = np.abs(self.vector)
        for leaf in self.leaves:
            part = scale[leaf.start : leaf.start + leaf.size]
            typical = float(np.sqrt(np.mean(part[part > 0] ** 2))) if part.any() else 1.0
            part[part <= ROUNDED * typical] = typical
        return scale

    def build(self, vector: Any, convert: Any = None) -> Any:
        """Return a theta like the one given from ``vector (d,)``; ``convert(part, leaf)`` makes its arrays."""
        make = convert or _as_given
        parts = iter(
            [make(vector[leaf.start : leaf.start + leaf.size].reshape(leaf.shape), leaf) for leaf in self.leaves]
        )
        return _filled(self._example, parts)

    def take(self, value: Any, what: str = "the gradient") -> np.ndarray:
        """Return a value of theta's structure, or a vector ``(d,)``, as ``(d,)``; raises :class:`UserError` otherwise."""
        try:
            found = [(path, as_numpy(part)) for path, part in _walk(value, "")]
        except UserError:
            found = []
        parts = self._in_order(value, found)
        sizes = [leaf.size for leaf in self.leaves]
        total = sum(part.size for part in parts)
        # a list of single numbers is a vector, whatever library its numbers are of
        flat = len(parts) == 1 or (len(self.leaves) == 1 and _sequence(value))
        if total == self.vector.size and ([part.size for part in parts] == sizes or flat):
            return np.concatenate([part.ravel() for part in parts])
        shapes = ", ".join(f"{path} {part.shape}".strip() for path, part in found) or type(value).__name__
        wanted = ", ".join(f"{leaf.path or 'theta'} {leaf.shape}" for leaf in self.leaves)
        raise UserError(f"{what} has shape {shapes}; theta is {wanted}")

    def _in_order(self, value: Any, found: list[tuple[str, np.ndarray]]) -> list[np.ndarray]:
        """Return the parts in theta's order: by their names where they have some, since other libraries sort them."""
        named = dict(found)
        paths = [leaf.path for leaf in self.leaves]
        if set(named) == set(paths):
            return [named[path] for path in paths]
        # names that are not theta's belong to other numbers
        return [] if isinstance(value, Mapping) or _named_fields(value) else [part for _, part in found]


def as_numpy(value: Any) -> np.ndarray:
    """Return a number or an array of any library as a NumPy array."""
    if hasattr(value, "detach"):
        value = value.detach().cpu()
    try:
        return np.asarray(value)
    except (TypeError, ValueError) as error:
        raise UserError(f"{type(value).__name__} is no array of numbers: {error}") from None


def _library(value: Any) -> str:
    root = type(value).__module__.partition(".")[0]
    if root in ("jax", "jaxlib"):
        return "jax"
    if root == "torch" or hasattr(value, "detach"):
        return "torch"
    return "number" if isinstance(value, int | float) else "numpy"


def _as_given(part: np.ndarray, leaf: Leaf) -> Any:
    """Return a part as what was given: a number, or an array of the same library."""
    if leaf.library == "number":
        return float(part)
    if leaf.library == "jax":
        import jax.numpy as jnp

        return jnp.asarray(part, dtype=leaf.dtype)
    if leaf.library == "torch":
        import torch

        return torch.as_tensor(np.array(part), dtype=getattr(torch, leaf.dtype))
    return np.array(part, dtype=leaf.dtype)


def _named_fields(value: Any) -> list[str] | None:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [field.name for field in dataclasses.fields(value)]
    return list(value._fields) if isinstance(value, tuple) and hasattr(value, "_fields") else None


def _sequence(value: Any) -> bool:
    """Return whether a list or tuple is a structure; one of plain numbers is an array."""
    if not isinstance(value, list | tuple):
        return False
    return not all(isinstance(part, int | float) for part in value)


def _walk(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield the path and value of every array in a structure, dicts in their own order."""
    if value is None:
        return
    if isinstance(value, Mapping):
        for key in value:
            yield from _walk(value[key], f"{path}.{key}" if path else str(key))
        return
    fields = _named_fields(value)
    if fields is not None:
        for name in fields:
            yield from _walk(getattr(value, name), f"{path}.{name}" if path else name)
    elif _sequence(value):
        for index, part in enumerate(value):
            yield from _walk(part, f"{path or 'theta'}[{index}]")
    else:
        yield path, value


def _filled(example: Any, parts: Iterator[Any]) -> Any:
    if example is None:
        return None
    if isinstance(example, Mapping):
        filled = {key: _filled(example[key], parts) for key in example}
        return filled if type(example) is dict else type(example)(filled)  # type: ignore[call-arg]
    fields = _named_fields(example)
    if fields is not None:
        values = {name: _filled(getattr(example, name), parts) for name in fields}
        return dataclasses.replace(example, **values) if dataclasses.is_dataclass(example) else type(example)(**values)  # type: ignore[type-var]
    if _sequence(example):
        return type(example)([_filled(part, parts) for part in example])
    return next(parts)
