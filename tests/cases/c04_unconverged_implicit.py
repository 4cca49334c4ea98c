"""vmex PR #367: implicit derivative of an inner solver that stops after four iterations.

Inner: minimise (z - x0)^2/2 + x1 (1 - cos z) by four steps of gradient descent from 0. Cost = (z - 0.3)^2.
RIGHT: complex step through the four iterations. ``implicit`` differentiates the optimality condition at the
point reached. ``converged`` is the cost after 400 iterations, for which ``implicit`` at its own point would be right.
"""

import numpy as np

theta = [1.2, 0.8]


def inner(x, n):
    z = 0.0
    for _ in range(n):
        z = z - 0.3 * (z - x[0] + x[1] * np.sin(z))
    return z


def cost(x):
    return (inner(x, 4) - 0.3) ** 2


def converged(x):
    return (inner(x, 400) - 0.3) ** 2


def implicit(x):
    z = inner(x, 4)
    by_x = np.array([1.0, -np.sin(z)]) / (1 + x[1] * np.cos(z))
    return 2 * (z - 0.3) * by_x
