"""scipy/scipy#11258, #18161: forward difference with step 1e-4*max(1,|x|) for a parameter of 1e-5 (a diffusivity). Right: closed form."""

import numpy as np

theta = [2e-5, 3.0]


def cost(x):
    return float(np.exp(-x[1] * x[0] / 1e-5 * 0.1) + x[1] ** 2 * 1e-2)


def right(x):
    e = np.exp(-x[1] * x[0] / 1e-5 * 0.1)
    return [-x[1] * 1e4 * e, -x[0] * 1e4 * e + 2e-2 * x[1]]


def scipy_like(x):
    g = []
    for i in range(2):
        h = 1e-4 * max(1, abs(x[i]))
        z = np.array(x, float)
        z[i] += h
        g.append((cost(z) - cost(x)) / h)
    return g
