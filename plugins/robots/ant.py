"""The task of gymnasium's ant: run forward with the torso at a safe height (Ant-v5, without contact cost)."""

from typing import Any


def observation(xp: Any, q: Any, v: Any) -> Any:
    """Positions without x and y, and velocities, (27, B)."""
    return xp.concat([q[2:], 0.1 * v])


def stage_cost(xp: Any, q: Any, v: Any, u: Any) -> Any:
    """Minus the forward velocity and 1 for a healthy state, plus 0.5 |u|^2, (B,)."""
    return 0.5 * xp.sum(u * u, axis=0) - v[0] - 1.0


def has_ended(xp: Any, q: Any, v: Any) -> Any:
    """Whether the torso has left heights of 0.2 m to 1 m, (B,)."""
    return (q[2] < 0.2) | (q[2] > 1.0)
