"""brax/Isaac-style vectorised costs: a cost that accepts a batch but normalises over all of it (jax #3970 is the same with psum).

``cost`` on an array (d, B) returns (B,) but divides by the norm of the whole array; on (d,) it is x0^2 x1 / |x|.
RIGHT: closed form ``grad`` for one theta. A checker that trusts the shape (B,) sees other numbers.
"""

import numpy as np

theta = [0.7, -0.4, 0.2]


def cost(x):
    x = np.asarray(x)
    return x[0] ** 2 * x[1] / np.linalg.norm(x)


def grad(x):
    n = np.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
    return np.array([2 * x[0] * x[1] / n, x[0] ** 2 / n, 0.0]) - x[0] ** 2 * x[1] / n**3 * np.asarray(x)
