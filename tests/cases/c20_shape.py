"""jax #3056, #6452, #1350: the gradient of a broadcast input is not summed and has the shape of the output.

cost(k) = sum((k a - 1)^2) for a number k and a of 4. RIGHT: 2 sum(a (k a - 1)). ``unsummed`` returns the four terms;
``column`` returns shape (2, 1) for a theta of 2; ``keyed`` returns the gradient in a dict of other names.
"""

import numpy as np

A = np.array([1.0, -0.5, 2.0, 0.3])
theta = 0.7
named = {"mass": 0.7, "gain": 0.2}


def cost(k):
    return np.sum((k * A - 1) ** 2)


def unsummed(k):
    return 2 * A * (k * A - 1)


def two(x):
    return np.sum((x[0] * A - x[1]) ** 2)


def column(x):
    r = x[0] * A - x[1]
    return np.array([[2 * r @ A], [-2 * r.sum()]])


def by_name(x):
    return two([x["mass"], x["gain"]])


def keyed(x):
    g = column([x["mass"], x["gain"]])[:, 0]
    return {"gain": g[1], "masses": g[0]}
