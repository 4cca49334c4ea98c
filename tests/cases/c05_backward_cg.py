"""jaxopt #466: the adjoint system of a fixed point is solved by conjugate gradients although its matrix is not symmetric.

z = tanh(M z + x) by iteration to rounding; cost = |z - 0.2|^2. ``cg`` solves (I - D M)^T a = dc/dz by plain CG and gives up
to the initial zero vector if the residual has not fallen after 20 iterations, as in the report. ``stopped`` returns what
5 iterations of CG left. RIGHT: ``right`` solves it directly; checked against complex step.
"""

import numpy as np

rng = np.random.default_rng(3)
M = 0.9 * np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.6], [0.0, -0.6, 0.0]]) + 0.05 * rng.standard_normal((3, 3))
theta = [0.3, -0.2, 0.4]


def solve(x):
    z = np.zeros(3, dtype=np.asarray(x).dtype)
    for _ in range(600):
        z = 0.5 * z + 0.5 * np.tanh(M @ z + np.asarray(x))
    return z


def cost(x):
    return float(np.sum((solve(np.array(x, dtype=float)) - 0.2) ** 2))


def system(x):
    z = solve(np.array(x, dtype=float))
    d = np.diag(1 - z * z)
    return (np.eye(3) - d @ M).T, d, 2 * (z - 0.2)


def right(x):
    a, d, b = system(x)
    return d @ np.linalg.solve(a, b)


def conjugate(a, b, n):
    y, r = np.zeros(3), b.copy()
    p = r
    for _ in range(n):
        ap = a @ p
        step = (r @ r) / (p @ ap)
        y, new = y + step * p, r - step * ap
        p, r = new + (new @ new) / (r @ r) * p, new
    return y, np.linalg.norm(b - a @ y) / np.linalg.norm(b)


def cg(x):
    a, d, b = system(x)
    y, left = conjugate(a, b, 20)
    return d @ (y if left < 1e-6 else np.zeros(3))


def stopped(x):
    a, d, b = system(x)
    return d @ conjugate(a, b, 5)[0]
