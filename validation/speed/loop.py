"""The gradient of `pushing` as a plain NumPy loop with a hand-written adjoint, as a baseline."""

import numpy as np


def gradient(scene, stiffness, theta, w):
    """Return df/dtheta ``(T, B)`` with the penalty spring and semi-implicit Euler, for ``theta (T,)``, ``w (T, B)``."""
    h, h_over_m, c, s = scene.dt, scene.dt / scene.mass, scene.velocity_factor, scene.speed
    goal, weight = np.array([[1.0], [2.0]]), np.array([[0.1], [10.0]])
    u = theta[:, None] + scene.sigma * w
    x, v = np.tile([[0.0], [1.0]], (1, w.shape[1])), np.tile([[s], [0.0]], (1, w.shape[1]))
    states = []
    for control in u:
        states.append((x, v))
        force = stiffness * np.maximum(0.0, x[0] + 1.0 - x[1])
        v = c * v + h_over_m * np.stack([control - force, force])
        x = x + h * v
    rest = np.array([[s], [0.0]])
    a, b = 2.0 * weight * (x - goal), 0.2 * (v - rest)
    result = np.empty_like(u)
    for t in range(len(u) - 1, -1, -1):
        x, v = states[t]
        d = b + h * a
        result[t] = h_over_m * d[0] + 2.0 * u[t]
        pull = np.where(x[1] - x[0] < 1.0, stiffness * h_over_m * (d[0] - d[1]), 0.0)
        a = a + 2.0 * weight * (x - goal) + np.stack([-pull, pull])
        b = c * d + 0.2 * (v - rest)
    return result
