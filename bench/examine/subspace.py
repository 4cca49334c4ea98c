"""The coordinates in which a gradient is checked: single components of theta, and random directions of groups.

A theta of up to :data:`MOST` numbers is checked component by component. A larger one is checked in a few of its components
and along one random direction of each group of its numbers, where a group is an array of theta, a part of one, or several.
Every number moves along one of these directions, so an error in any of them changes a slope. No array is larger than a
few thetas.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bench.gradient.check import Check, Part, extremes
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
        self._thetas = np.empty((0, 0))

    @property
    def size(self) -> int:
        """Number of coordinates m."""
        return len(self.components) + len(self.groups)

    def place(self, z: np.ndarray, thetas: np.ndarray | None = None) -> np.ndarray:
        """Return the thetas ``(d, B)`` at coordinates ``z (m, B)``, written into ``thetas`` if given."""
        thetas = np.empty((self.theta.size, z.shape[1])) if thetas is None else thetas
        thetas[:] = self.theta[:, None]
        if self.components:
            thetas[self.components] += z[: len(self.components)]
        for k, group in enumerate(self.groups, len(self.components)):
            if z[k].any():
                thetas[group.first : group.last] += group.vector[:, None] * z[k]
        return thetas

    def project(self, gradient: np.ndarray) -> np.ndarray:
        """Return the derivatives by the coordinates ``(m,)`` from a gradient ``(d,)``."""
        along = [float(group.vector @ gradient[group.first : group.last]) for group in self.groups]
        return np.r_[gradient[self.components], along]

    def costs(self, cost: Callable[[np.ndarray], np.ndarray], z: np.ndarray, width: int) -> np.ndarray:
        """Return the costs ``(B,)`` at ``z (m, B)``, from ``cost`` of at most ``width`` thetas ``(d, width)`` at a time."""
        # one array for all calls, since new memory for a million numbers takes longer than writing them
        costs = [np.zeros(0)]
        for first in range(0, z.shape[1], width):
            part = z[:, first : first + width]
            if self._thetas.shape != (self.theta.size, part.shape[1]):
                self._thetas = np.empty((self.theta.size, part.shape[1]))
            costs.append(cost(self.place(part, self._thetas)))
        return np.concatenate(costs)

    def restore(self, check: Check) -> Check:
        """Return a check in these coordinates with its parts named after theta's components and groups."""
        return replace(check, parts=tuple(self._restore_part(part) for part in check.parts))

    def _restore_part(self, part: Part) -> Part:
        if part.component is None:
            return part
        if part.component < len(self.components):
            return replace(part, component=self.components[part.component])
        return replace(part, component=None, name=self.groups[part.component - len(self.components)].name)


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
    random = np.random.default_rng([seed, 0x67726F75])
    leaves = layout.leaves
    spans: list[tuple[str, int, int]] = []
    if len(leaves) == 1:
        for leaf in leaves:
            edges = np.linspace(0, leaf.size, min(BLOCKS, leaf.size) + 1).astype(int)
            for first, last in itertools.pairwise(edges):
                spans.append((leaf.block(int(first), int(last)), leaf.start + int(first), leaf.start + int(last)))
    else:
        for part in np.array_split(np.arange(len(leaves)), min(GROUPS, len(leaves))):
            a, b = leaves[int(part[0])], leaves[int(part[-1])]
            spans.append((a.name if a is b else f"{a.name} to {b.name}", a.start, b.start + b.size))
    groups = []
    for name, first, last in spans:
        vector = random.standard_normal(last - first)
        vector *= scale[first:last] / np.linalg.norm(vector)
        groups.append(Group(name, first, last, vector))
    return groups


def locate(
    layout: ParameterTree,
    group: Group,
    theta: np.ndarray,
    gradient: np.ndarray,
    cost: Callable[[np.ndarray], np.ndarray],
    step: float,
    error: float,
    noise: float,
) -> tuple[str, int | None]:
    """Return the name of the numbers of a group that cause the ``error`` of its slope, by halving, and the index of a single one.

    Each halving takes two costs. The search ends at one number, at ``noise`` (the uncertainty of a slope), or where both
    halves have a share of the error.
    """
    first, last = group.first, group.last
    while last - first > 1:
        middle = (first + last) // 2
        moved = np.repeat(theta[:, None], 2, axis=1)
        part = group.vector[first - group.first : middle - group.first]
        moved[first:middle] += part[:, None] * np.array([-step, step])
        costs = cost(moved)
        left_error = float((costs[1] - costs[0]) / (2 * step) - part @ gradient[first:middle])
        rest = error - left_error
        if not np.isfinite(left_error) or min(abs(left_error), abs(rest)) > (1 - SHARE) * abs(error):
            break
        if max(abs(left_error), abs(rest)) < 2.0 * noise:
            break
        first, last, error = (first, middle, left_error) if abs(left_error) > abs(rest) else (middle, last, rest)
    inside = [leaf for leaf in layout.leaves if leaf.start < last and leaf.start + leaf.size > first]
    blocks = [leaf.block(max(first - leaf.start, 0), min(last - leaf.start, leaf.size)) for leaf in inside]
    return blocks[0] if len(blocks) == 1 else f"{blocks[0]} to {blocks[-1]}", first if last - first == 1 else None
