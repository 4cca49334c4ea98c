"""Minimal: atol is not applied along the random directions. Errors of 1e-3 with atol=1e-2 must be a warning (docs/examine.md).

cost = x0 + 2 x1 + sin(x2), gradient off by 1e-3 in x0. RIGHT: closed form; status 0 with atol=1e-2, status 1 without.
"""

import numpy as np

theta = [0.4, 0.3, 0.2]


def cost(x):
    return x[0] + 2 * x[1] + np.sin(x[2])


def grad(x):
    return [1 + 1e-3, 2.0, np.cos(x[2])]


def flat(x):
    return 0.1 + 0.6 * (x[0] > 0.9)


def residue(x):
    return [0.0, 6.6e-8, -6.7e-8]
