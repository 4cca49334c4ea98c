"""The coordinates in which a gradient is checked: single components of theta, and random directions of groups.

A theta of up to :data:`MOST` numbers is checked component by component. A larger one is checked in a few of its components
and along one random direction of each group of its numbers, where a group is an array of theta, a part of one, or several.
Every number moves along one of these directions, so an error in any of them changes a slope. No array is larger than a
few thetas.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from bench.gradient.check import Check, Part, extremes
from bench.gradient.direction import Function
from bench.simulator.tree import ParameterTree

MOST = 16
"""Most components checked one by one."""
GROUPS = 12
"""Most groups of a larger theta."""
BLOCKS = 4
"""Number of blocks of a theta that is one array."""
SHARE = 0.9
"""Least share of a group's error that one half has to have for the search to go on in it."""


@dataclass(frozen=True)
class Group:
    """Neighbouring numbers of theta that move together along a random direction of length 1, in units of their scales."""

    name: str
    first: int
    last: int
    vector: np.ndarray
    """``(last - first,)``."""


class Subspace:
    """Coordinates z of theta + V z, with the columns of V as components and directions of groups."""

    def __init__(self, layout: ParameterTree, scale: np.ndarray, components: list[int], groups: list[Group]) -> None:
        self.theta, self.components, self.groups = layout.vector, components, groups
        self.scale = np.r_[scale[components], np.ones(len(groups))]
        """The size of each coordinate ``(m,)``."""

    @property
    def size(self) -> int:
        """Number of coordinates m."""
        return len(self.components) + len(self.groups)

    def place(self, z: np.ndarray) -> np.ndarray:
        """Return the thetas ``(d, B)`` at coordinates ``z (m, B)``."""
        thetas = np.repeat(self.theta[:, None], z.shape[1], axis=1)
        thetas[self.components] += z[: len(self.components)]
        for k, group in enumerate(self.groups, len(self.components)):
            if z[k].any():
                thetas[group.first : group.last] += group.vector[:, None] * z[k]
        return thetas

    def project(self, gradient: np.ndarray) -> np.ndarray:
        """Return the derivatives by the coordinates ``(m,)`` from a gradient ``(d,)``."""
        along = [float(group.vector @ gradient[group.first : group.last]) for group in self.groups]
        return np.r_[gradient[self.components], along]

    def restore(self, check: Check) -> Check:
        """Return a check in these coordinates with its parts named after theta's components and groups."""
        return replace(check, parts=tuple(self._restore_part(part) for part in check.parts))

    def _restore_part(self, part: Part) -> Part:
        if part.component is None:
            return part
        if part.component < len(self.components):
            return replace(part, component=self.components[part.component])
        return replace(part, component=None, name=self.groups[part.component - len(self.components)].name)


def in_parts(function: Function, z: np.ndarray, width: int) -> np.ndarray:
    """Return ``function(z)``, ``(B,)``, for ``z (..., B)``, ``width`` columns at a time, since memory holds few large thetas."""
    parts = (z[..., first : first + width] for first in range(0, max(z.shape[-1], 1), width))
    return np.concatenate([function(part) for part in parts])


def count_of(dim: int) -> int:
    """Return the largest number of coordinates for a theta of ``dim`` numbers."""
    return dim if dim <= MOST else MOST + GROUPS


def choose(
    layout: ParameterTree, scale: np.ndarray, gradient: np.ndarray | None, seed: int, most: int = MOST
) -> Subspace:
    """Return the coordinates for a theta: all of its components, or those with the largest and smallest |gradient * scale|.

    ``gradient (d,)`` decides which components of a large theta are checked one by one.
    """
    dim = layout.vector.size
    if dim <= MOST:
        return Subspace(layout, scale, list(range(dim)), [])
    chosen = extremes(scale if gradient is None else gradient * scale, most)
    return Subspace(layout, scale, chosen, groups_of(layout, scale, seed))


def groups_of(layout: ParameterTree, scale: np.ndarray, seed: int) -> list[Group]:
    """Return the groups of a theta: each array, several small neighbours together, or blocks of a single array."""
    random, starts = np.random.default_rng([seed, 0x67726F75]), np.array([leaf.start for leaf in layout.leaves])
    if starts.size == 1:
        edges = np.linspace(0, scale.size, min(BLOCKS, scale.size) + 1).astype(int)
    else:
        edges = np.array([*(part[0] for part in np.array_split(starts, min(GROUPS, starts.size))), scale.size])
    groups = []
    for first, last in itertools.pairwise(edges.tolist()):
        vector = random.standard_normal(last - first)
        vector *= scale[first:last] / np.linalg.norm(vector)
        groups.append(Group(layout.block(first, last), first, last, vector))
    return groups


def locate(group: Group, theta: np.ndarray, gradient: np.ndarray, cost: Function, part: Part) -> tuple[int, int]:
    """Return the first and the last number + 1 of a group that cause the error of its slope, ``part``, by halving.

    Each halving takes two costs. The search ends at one number, at the uncertainty of the slope, or where both halves have a
    share of the error.
    """
    first, last, error = group.first, group.last, part.difference - part.program
    while last - first > 1:
        middle = (first + last) // 2
        vector = group.vector[first - group.first : middle - group.first]
        moved = np.repeat(theta[:, None], 2, axis=1)
        moved[first:middle] += np.outer(vector, [-part.step, part.step])
        minus, plus = cost(moved)
        left = float((plus - minus) / (2 * part.step) - vector @ gradient[first:middle])
        small, large = sorted((abs(left), abs(error - left)))
        if not (small <= (1 - SHARE) * abs(error) and large >= 2.0 * part.uncertainty):
            break
        is_left = large == abs(left)
        first, last, error = (first, middle, left) if is_left else (middle, last, error - left)
    return first, last
