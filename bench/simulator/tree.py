"""Flattens a theta of any structure into one vector: numbers, arrays, and nested dicts, lists, tuples and dataclasses.

Each number is named by its path: ``mass``, ``gains[3]``, ``legs[0].stiffness``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from bench.errors import UserError, printable, unknown

ROUNDING = 1e-14
"""Size relative to the array's root mean square up to which a number counts as 0 with rounding errors."""
MAX_SIZE = 20_000_000
"""Maximum number of entries of theta: a few dozen thetas are stored at the same time."""

MAX_NAMED = 100_000
"""Largest array whose entries are searched by name."""


@dataclass(frozen=True)
class Leaf:
    """One array of theta: its position in the vector, shape, library and type."""

    path: str
    shape: tuple[int, ...]
    start: int
    library: str
    """``numpy``, ``jax``, ``torch``, or ``number`` for a plain Python number."""
    dtype: str
    """Its floating-point type."""
    device: str = "cpu"
    """Where a tensor of torch is."""

    @property
    def size(self) -> int:
        """Number of entries."""
        return int(np.prod(self.shape, dtype=int))

    @property
    def name(self) -> str:
        """Name of the whole array: its path without control characters, or ``theta``."""
        return printable(self.path) or "theta"

    def entry(self, index: int) -> str:
        """Return the name of one entry, such as ``gains[3]``."""
        if not self.shape:
            return self.name
        return f"{self.name}[{','.join(str(at) for at in np.unravel_index(index, self.shape))}]"

    def block(self, first: int, last: int) -> str:
        """Return the name of the entries from ``first`` up to ``last``, such as ``gains[0] to gains[3]``."""
        if last - first == 1:
            return self.entry(first)
        return self.name if last - first == self.size else f"{self.entry(first)} to {self.entry(last - 1)}"


class ParameterTree:
    """Flattens a theta into a vector ``(d,)``, and rebuilds thetas of the same structure from vectors.

    Raises :class:`UserError` for a theta without numbers, or with an entry that is not a real number.
    """

    def __init__(self, theta: Any) -> None:
        self._example = theta
        self.leaves: list[Leaf] = []
        values = []
        start = 0
        for path, value in _arrays(theta):
            array = as_numpy(value)
            if array.dtype.kind not in "fiu":
                given = type(value).__name__ if array.dtype.kind == "O" else array.dtype
                raise UserError(f"{path or 'theta'} is of type {given}: theta consists of real numbers")
            dtype = str(array.dtype) if array.dtype.kind == "f" else "float64"
            library = _library(value)
            device = str(getattr(value, "device", "cpu")) if library == "torch" else "cpu"
            self.leaves.append(Leaf(path, array.shape, start, library, dtype, device))
            values.append(array.astype(np.float64).ravel())
            start += array.size
        if not start:
            raise UserError("theta has no numbers: give an array, or a dict of arrays, theta={'mass': 1.0}")
        self.vector = np.concatenate(values)
        self._whole = _stacked(theta).shape
        if start > MAX_SIZE:
            raise UserError(
                f"theta has {start:,} numbers and at most {MAX_SIZE:,} can be examined: give fewer, or a part of them"
            )
        if not np.isfinite(self.vector).all():
            bad = self.name(int(np.argmin(np.isfinite(self.vector))))
            raise UserError(f"{bad} is not finite: give a theta of finite numbers")

    def inside(self, first: int, last: int) -> list[Leaf]:
        """Return the arrays with entries from ``first`` up to ``last``, by the entries' indices in the vector."""
        return [leaf for leaf in self.leaves if leaf.start < last and leaf.start + leaf.size > first]

    def name(self, index: int) -> str:
        """Return the name of an entry by its index in the vector, ``gains[3]``."""
        (leaf,) = self.inside(index, index + 1)
        return leaf.entry(index - leaf.start)

    def block(self, first: int, last: int) -> str:
        """Return the name of the entries from ``first`` up to ``last``: ``gains``, ``gains[0] to gains[3]``, ``mass to gains``."""
        names = [
            leaf.block(max(first - leaf.start, 0), min(last - leaf.start, leaf.size))
            for leaf in self.inside(first, last)
        ]
        return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"

    def match(self, name: str) -> list[int]:
        """Return the indices of the entries with a name or path: ``gains[3]``, ``gains`` or ``legs[0]``.

        Raises :class:`UserError` if there is none.
        """
        inside = [leaf for leaf in self.leaves if leaf.name == name or leaf.name.startswith((f"{name}.", f"{name}["))]
        if inside:
            return [i for leaf in inside for i in range(leaf.start, leaf.start + leaf.size)]
        for leaf in self.leaves:
            if name.startswith(f"{leaf.name}[") and leaf.size <= MAX_NAMED:
                entries = [leaf.entry(i) for i in range(leaf.size)]
                if name in entries:
                    return [leaf.start + entries.index(name)]
        raise unknown("input", name, [leaf.name for leaf in self.leaves])

    def spread(self, value: Any, what: str, default: float) -> np.ndarray:
        """Return one number per entry ``(d,)``, from a number, a mapping of names to numbers, or theta's structure.

        Entries that a mapping does not name get ``default``.
        """
        size = self.vector.size
        if isinstance(value, int | float | np.number):
            return np.full(size, float(value))
        if isinstance(value, Mapping) and not self._has_structure(value):
            result = np.full(size, default)
            for name, given in value.items():
                index = self.match(str(name))
                try:
                    result[index] = np.asarray(as_numpy(given), dtype=np.float64).ravel()
                except ValueError:
                    raise UserError(f"{what}: {name} has {len(index)} numbers: give one number, or as many") from None
            return result
        return self.flatten(value, what).astype(np.float64)

    def _has_structure(self, value: Any) -> bool:
        """Return whether a mapping has an array of theta's size for each leaf."""
        try:
            self.flatten(value)
        except UserError:
            return False
        return True

    @property
    def flat(self) -> bool:
        """Whether theta itself is a single vector ``(d,)``."""
        return len(self.leaves) == 1 and len(self.leaves[0].shape) == 1 and not self.leaves[0].path

    def scales(self) -> np.ndarray:
        """Return the scale of each entry, ``(d,)``: |entry|; for 0 the array's nonzero RMS; 1 if the array is all 0."""
        scale = np.abs(self.vector)
        for leaf in self.leaves:
            part = scale[leaf.start : leaf.start + leaf.size]
            typical = float(np.sqrt(np.mean(part[part > 0] ** 2))) if part.any() else 1.0
            part[part <= ROUNDING * typical] = typical
        return scale

    def unflatten(self, vector: Any, convert: Any = None) -> Any:
        """Return a theta of the original structure from ``vector (d,)``; ``convert(part, leaf)`` creates its arrays."""
        create = convert or _restore
        parts = iter(
            [create(vector[leaf.start : leaf.start + leaf.size].reshape(leaf.shape), leaf) for leaf in self.leaves]
        )
        return _fill(self._example, parts)

    def flatten(self, value: Any, what: str = "the gradient") -> np.ndarray:
        """Return ``value``, which has theta's structure or is a vector ``(d,)``, as a vector ``(d,)``.

        Raises :class:`UserError` if it has another structure or size.
        """
        whole = _stacked(value)
        # a vector of all numbers fits every structure
        if whole.size == self.vector.size and (whole.ndim < 2 or whole.shape == self._whole):
            return whole.ravel()
        try:
            leaves = [(path, as_numpy(part)) for path, part in _arrays(value)]
        except UserError:
            leaves = []
        parts = self._reorder(value, leaves)
        sizes = [leaf.shape if leaf.size > 1 else leaf.size for leaf in self.leaves]
        if [part.shape if part.size > 1 else part.size for part in parts] == sizes:
            return np.concatenate([part.ravel() for part in parts])
        numeric = leaves and all(part.dtype.kind in "biufc" for _, part in leaves)
        shapes = (
            str(tuple(getattr(value, "shape", whole.shape or (1,) * hasattr(value, "__len__"))))
            if whole.size
            else ", ".join(f"{path} {part.shape}".strip() for path, part in leaves)
        )
        given = f"has shape {shapes}" if numeric else f"is {type(value).__name__} {value!r}"[:200]
        expected = ", ".join(f"{leaf.path} {leaf.shape}".strip() for leaf in self.leaves)
        turned = zip([whole, *parts], [self._whole, *(leaf.shape for leaf in self.leaves)], strict=False)
        hint = ": is it transposed?" if any(part.ndim > 1 and part.T.shape == shape for part, shape in turned) else ""
        raise UserError(f"{what} {given}, and theta has shape {expected}{hint}")

    def _reorder(self, value: Any, leaves: list[tuple[str, np.ndarray]]) -> list[np.ndarray]:
        """Return the arrays in theta's order, matched by path if possible, since some libraries sort dict keys."""
        named = dict(leaves)
        paths = [leaf.path for leaf in self.leaves]
        if set(named) == set(paths):
            return [named[path] for path in paths]
        # a structure with other names than theta's contains other numbers
        return [] if isinstance(value, Mapping) or _named_fields(value) else [part for _, part in leaves]


def numbers(value: Any) -> np.ndarray:
    """Return all numbers of a structure as a vector, in its order, without a copy of a single array; empty without numbers."""
    try:
        parts = [as_numpy(part).ravel() for _, part in _arrays(value)]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)
    except (UserError, ValueError):
        return np.empty(0)


def _stacked(value: Any) -> np.ndarray:
    """Return an array, or a list of arrays of one shape, as one array; an empty one for other structures."""
    try:
        if _is_structure(value) and not _named_fields(value):
            return np.stack([_stacked(part) for part in value])
        array = as_numpy(value)
    except (UserError, ValueError, RecursionError):
        return np.empty(0)
    is_array = array.dtype.kind in "biufc" and not _named_fields(value)
    return array.reshape(() if array.size == 1 else array.shape) if is_array else np.empty(0)


def as_numpy(value: Any) -> np.ndarray:
    """Return a number or an array of any library as a NumPy array."""
    if hasattr(value, "detach"):
        value = value.detach().cpu()
    try:
        array = np.asarray(value)
        if array.dtype.kind == "O" and all(hasattr(part, "__float__") for part in array.ravel()):
            # numbers of a library without arrays, such as Decimal
            array = np.array([float(part) for part in array.ravel()]).reshape(array.shape)
    except (TypeError, ValueError) as error:
        raise UserError(f"{type(value).__name__} is not an array of numbers: {error}") from None
    return array


def _library(value: Any) -> str:
    root = type(value).__module__.partition(".")[0]
    if root in ("jax", "jaxlib"):
        return "jax"
    if root == "torch" or hasattr(value, "detach"):
        return "torch"
    is_number = isinstance(value, int | float) or (hasattr(value, "__float__") and not hasattr(value, "dtype"))
    return "number" if is_number else "numpy"


def _restore(part: np.ndarray, leaf: Leaf) -> Any:
    """Return a leaf's part of the vector in its original form: a number, or an array of the same library and type."""
    if leaf.library == "number":
        return float(part)
    if leaf.library == "jax":
        import jax.numpy as jnp

        return jnp.asarray(part, dtype=leaf.dtype)
    if leaf.library == "torch":
        import torch

        return torch.as_tensor(np.array(part), dtype=getattr(torch, leaf.dtype), device=leaf.device)
    return np.array(part, dtype=leaf.dtype)


def _named_fields(value: Any) -> list[str] | None:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [field.name for field in dataclasses.fields(value)]
    return list(value._fields) if isinstance(value, tuple) and hasattr(value, "_fields") else None


def _is_structure(value: Any) -> bool:
    """Return whether a value is a list or tuple of parts; a list or tuple of plain numbers is an array instead."""
    if not isinstance(value, list | tuple):
        return False
    return not all(isinstance(part, int | float) for part in value)


def _arrays(value: Any) -> list[tuple[str, Any]]:
    """Return the path and value of each array in a structure; raises :class:`UserError` if the structure has no end."""
    try:
        return list(_traverse(value, ""))
    except RecursionError:
        raise UserError("a structure is nested too deeply, or contains itself") from None


def _traverse(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield the path and value of each array in a structure; dicts are traversed in insertion order."""
    found = _parts(value)
    if found is None and value is not None:
        yield path, value
    for name, part in found[0] if found else ():
        start = path or "theta" * name.startswith("[")
        yield from _traverse(part, (start + name).removeprefix("."))


def _fill(example: Any, arrays: Iterator[Any]) -> Any:
    found = _parts(example)
    if found is None:
        return None if example is None else next(arrays)
    return found[1]([_fill(part, arrays) for _, part in found[0]])


def _parts(value: Any) -> tuple[list[tuple[str, Any]], Callable[[list[Any]], Any]] | None:
    """Return the parts of a structure by the ends of their paths, and a function that builds it of others; None for an array."""
    fields = _named_fields(value)
    if isinstance(value, Mapping):
        return [(f".{key}", value[key]) for key in value], lambda parts: type(value)(
            dict(zip(value, parts, strict=True))
        )  # type: ignore[call-arg]
    if fields is not None:
        made: Any = partial(dataclasses.replace, value) if dataclasses.is_dataclass(value) else type(value)
        named = [(f".{name}", getattr(value, name)) for name in fields]
        return named, lambda parts: made(**dict(zip(fields, parts, strict=True)))
    return ([(f"[{i}]", part) for i, part in enumerate(value)], type(value)) if _is_structure(value) else None
