"""theseus #39: implicit backward through one last optimiser step that is damped by a step size of 0.3.

Curve fit y = a exp(b t) by Gauss-Newton with step 0.3 to convergence; theta scales two data points; cost = (a - 1)^2 + b^2.
RIGHT: derivative of the converged fit (complex step, ``right``). ``damped`` is exactly 0.3 times it: a wrong factor.
"""

import numpy as np

T = np.linspace(0, 1, 6)
Y = 1.3 * np.exp(-0.7 * T) + 0.02 * np.cos(9 * T)
theta = [1.0, 1.0]


def step(p, x):
    y = Y * np.array([x[0], 1, 1, x[1], 1, 1])
    e = np.exp(p[1] * T)
    j = np.stack([e, p[0] * T * e], 1)
    return -np.linalg.solve(j.T @ j, j.T @ (p[0] * e - y))


def fit(x):
    p = np.array([1.0, -0.5], dtype=np.asarray(x).dtype)
    for _ in range(120):
        p = p + 0.3 * step(p, x)
    return p


def cost(x):
    p = fit(np.asarray(x, dtype=None))
    return (p[0] - 1) ** 2 + p[1] ** 2


def damped(x):
    """Differentiate the last step alone, p fixed, as the attached step of the layer does."""
    p = fit(np.array(x, float))
    by_x = np.array([step(p.astype(complex), np.array(x) + 1e-30j * r).imag for r in np.eye(2)]).T / 1e-30
    return np.array([2 * (p[0] - 1), 2 * p[1]]) @ (0.3 * by_x)
