"""warp #1552: the adjoint of a reduction takes the last candidate that was visited instead of the largest.

cost = sum over three probes of max_j (c_j x_i + d_j); ``last`` uses the slope of the last visited j.
RIGHT: slope of the winning j (``right``); at theta no tie.
"""

import numpy as np

C, D = np.array([0.2, 1.5, -0.7, 0.9]), np.array([0.3, -0.2, 0.5, 0.1])
theta = [0.4, 1.2, -0.8]


def cost(x):
    return np.sum(np.max(np.outer(x, C) + D, axis=1) ** 2)


def last(x):
    values = np.outer(x, C) + D
    return 2 * values.max(1) * C[-1]
