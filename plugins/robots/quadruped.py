"""The task of the quadruped: stand upright and move forward at 0.5 m/s."""

from typing import Any

SPEED = 0.5
"""Wanted forward velocity [m/s]."""
HEIGHT = 0.288
"""Height of the torso in the stance [m]."""
STANCE = (0.0, 0.9, -1.8)
"""Angles of a leg's joints in the stance [rad]."""


def observation(xp: Any, q: Any, v: Any) -> Any:
    """Height, orientation, joint angles from the stance, and all velocities, each of order 1, (35, B)."""
    joints = xp.stack([q[7 + i] - STANCE[i % 3] for i in range(12)])
    return xp.concat([10.0 * (q[2:3] - HEIGHT), q[3:7], joints, v[:6], 0.1 * v[6:]])


def stage_cost(xp: Any, q: Any, v: Any, u: Any) -> Any:
    """Squared errors of velocity, height and orientation, and the servos' offsets from the joint angles, (B,)."""
    upright = 2.0 * (q[4] ** 2 + q[5] ** 2)  # 1 - cosine of the tilt
    effort = xp.sum((u - q[7:]) ** 2, axis=0)
    return (v[0] - SPEED) ** 2 + v[1] ** 2 + 20.0 * (q[2] - HEIGHT) ** 2 + upright + 0.01 * effort
