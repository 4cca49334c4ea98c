"""The task of gymnasium's half-cheetah: run forward, with a small price on the controls (HalfCheetah-v5)."""

from typing import Any

n_start = 9
"""Numbers of a random start: the velocities."""


def observation(xp: Any, q: Any, v: Any) -> Any:
    """Positions without x, and velocities, (17, B)."""
    return xp.concat([q[1:], 0.1 * v])


def stage_cost(xp: Any, q: Any, v: Any, u: Any) -> Any:
    """Minus the forward velocity plus 0.1 |u|^2, (B,)."""
    return 0.1 * xp.sum(u * u, axis=0) - v[0]


def random_start(xp: Any, q: Any, v: Any, e: Any) -> Any:
    """Normal velocities of 0.1."""
    return q, v + 0.1 * e
