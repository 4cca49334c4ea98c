"""States whose positions are on a manifold, such as unit quaternions, and changes of states in tangent coordinates.

A change of q is a vector of length ``n_v``: 3 numbers for a rotation, which a quaternion describes by 4. Step Jacobians
and derivatives by states are derivatives by changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bench.model.ops import Array
from bench.model.scene import EngineScene, MechanicalScene

SIZES = {"free": (7, 6), "ball": (4, 3), "slide": (1, 1), "hinge": (1, 1)}
"""Lengths of the positions and of the velocities of a joint."""
STEP = 1e-4
"""Change for central differences of retractions, whose errors are of second order."""


@dataclass(frozen=True)
class JointScene(EngineScene):
    """A role: an engine's scene with free or ball joints, whose orientations are unit quaternions (w, x, y, z).

    The conventions are MuJoCo's: a free joint has position and quaternion, and velocities in m/s (world axes) and rad/s
    (body axes).
    """

    joints: ClassVar[tuple[str, ...]]
    """The twin's joints in order, each ``free``, ``ball``, ``slide`` or ``hinge``. They set ``n_q`` and ``n_v``."""

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        joints = getattr(cls, "joints", None)
        if not isinstance(joints, tuple):
            return  # an instance decides
        if strange := [joint for joint in joints if joint not in SIZES]:
            raise TypeError(f"{cls.__name__} has the joint {strange[0]!r}: allowed are {', '.join(SIZES)}")
        if joints:
            cls.n_q, cls.n_v = (sum(SIZES[joint][i] for joint in cls.joints) for i in (0, 1))  # type: ignore[assignment, method-assign]

    def retract(self, xp: Any, q: Array, change: Array) -> Array:
        """Return the positions ``(n_q, B)`` at a change ``(n_v, B)`` from q; exact to second order in the change."""
        parts = []
        for is_turn, at, by in self._pieces():
            if not is_turn:
                parts.append(q[at] + change[by])
                continue
            half = change[by] / 2
            moved = _times(xp, q[at], [1.0 + 0.0 * half[0], *half])
            parts.append(moved / xp.sqrt(xp.sum(moved * moved, axis=0)))
        return xp.concat(parts)

    def difference(self, xp: Any, q: Array, start: Array) -> Array:
        """Return the change ``(n_v, B)`` from the positions ``start`` to q ``(n_q, B)``; exact to second order."""
        parts = []
        for is_turn, at, _ in self._pieces():
            if not is_turn:
                parts.append(q[at] - start[at])
                continue
            w, x, y, z = start[at]
            turn = _times(xp, xp.stack([w, -x, -y, -z]), q[at])
            parts.append(2 * turn[1:] / turn[:1])
        return xp.concat(parts)

    def _pieces(self) -> Iterator[tuple[bool, slice, slice]]:
        """Yield, for each position vector or quaternion, whether it is a quaternion, and its entries of q and of v."""
        at = by = 0
        kinds = [kind for joint in self.joints for kind in (("place", "ball") if joint == "free" else (joint,))]
        for kind in kinds:
            n_q, n_v = (3, 3) if kind == "place" else SIZES[kind]
            yield kind == "ball", slice(at, at + n_q), slice(by, by + n_v)
            at, by = at + n_q, by + n_v


def _times(xp: Any, a: Any, b: Any) -> Array:
    """Return the product of quaternions ``(4, B)``."""
    (s, x, y, z), (t, u, v, w) = a, b
    return xp.stack(
        [
            s * t - x * u - y * v - z * w,
            s * u + x * t + y * w - z * v,
            s * v - x * w + y * t + z * u,
            s * w + x * v - y * u + z * t,
        ]
    )


def n_changes(scene: MechanicalScene) -> int:
    """Return the length of a change of the state (q, v)."""
    return scene.n_v + (scene.n_v if isinstance(scene, JointScene) else scene.n_q)


def retract(scene: MechanicalScene, xp: Any, x: Array, change: Array) -> Array:
    """Return the state ``(n, B)`` at a change ``(n_changes, B)`` from the state x ``(n, B)``."""
    if not isinstance(scene, JointScene):
        return x + change
    n_q, n_v = scene.n_q, scene.n_v
    return xp.concat([scene.retract(xp, x[:n_q], change[:n_v]), x[n_q:] + change[n_v:]])


def difference(scene: MechanicalScene, xp: Any, x: Array, start: Array) -> Array:
    """Return the change ``(n_changes, B)`` from the state ``start`` to the state x, both ``(n, B)``."""
    if not isinstance(scene, JointScene):
        return x - start
    n_q = scene.n_q
    return xp.concat([scene.difference(xp, x[:n_q], start[:n_q]), x[n_q:] - start[n_q:]])


def slope_by_changes(scene: MechanicalScene, x: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return the derivative by changes ``(n_changes, B)`` of a function of states x whose derivative is ``slope (n, B)``."""
    if not isinstance(scene, JointScene):
        return slope
    rows = []
    for i in range(n_changes(scene)):
        change = np.zeros((n_changes(scene), x.shape[1]))
        change[i] = STEP
        moved = retract(scene, np, x, change) - retract(scene, np, x, -change)
        rows.append((moved * slope).sum(axis=0) / (2 * STEP))
    return np.stack(rows)
