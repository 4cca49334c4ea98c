"""scipy #11493: cost and gradient write into an array that is allocated once and returned every time.

RIGHT: the gradient is right (closed form). A checker that keeps references instead of numbers sees equal costs.
"""

import numpy as np

theta = [2.0, 2.0]
VALUE, SLOPE = np.zeros(()), np.zeros(2)


def cost(x):
    VALUE[...] = 100 * (x[1] - x[0] ** 2) ** 2 + (1 - x[0]) ** 2
    return VALUE


def grad(x):
    SLOPE[:] = [-400 * x[0] * (x[1] - x[0] ** 2) - 2 * (1 - x[0]), 200 * (x[1] - x[0] ** 2)]
    return SLOPE


def double(x):
    SLOPE[:] = [-400 * x[0] * (x[1] - x[0] ** 2) - 2 * (1 - x[0]), 200 * (x[1] - x[0] ** 2)]
    SLOPE[0] *= 1.2
    return SLOPE


def work(x):
    """A cost that uses its argument as working memory."""
    x[0] *= 2
    return float(x[0] ** 2 + x[0] * x[1])


def work_grad(x):
    return [8 * x[0] + 2 * x[1], 2 * x[0]]
