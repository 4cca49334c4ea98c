"""Minimal: refined= excuses a planted error. Explicit Euler of y' = -k sin y + drive; refined has 50 times the steps.

RIGHT: complex step. ``five`` is 0.96 times it, and farther from the refined cost's derivative than the cost's own derivative is.
"""

import numpy as np

theta = [0.9, 1.4]


def rollout(x, n):
    y, dt = x[0] * 1, 2.0 / n
    for _ in range(n):
        y = y + dt * (-x[1] * np.sin(y) + 0.3)
    return (y - 1.0) ** 2


def cost(x):
    return rollout(x, 40)


def refined(x):
    return rollout(x, 2000)


def slope(f, x):
    return np.array([f(np.array(x) + 1e-30j * r).imag for r in np.eye(2)]) / 1e-30


def five(x):
    return 0.96 * slope(cost, x)
