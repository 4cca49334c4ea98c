"""drake #10654, Genesis PR #2842: the derivative of a rotated point by a quaternion leaves out the normalisation.

cost = (R(q / |q|) p - target)^2. ``unit`` differentiates R(q) p as a polynomial in q, as if |q| stayed 1.
RIGHT: complex step of the cost. At |q| = 1 the difference is the radial part only.
"""

import numpy as np

theta = [0.8, 0.36, -0.48, 0.0]  # |q| = 1
P, TARGET = np.array([0.3, -0.5, 1.0]), np.array([0.2, 0.1, 0.4])


def rotate(q, p):
    w, u = q[0], q[1:]
    return p * (w * w - u @ u) + 2 * u * (u @ p) + 2 * w * np.cross(u, p)


def cost(q):
    q = np.asarray(q)
    r = rotate(q / np.sqrt(q @ q), P) - TARGET
    return r @ r


def unnormalised(q):
    r = rotate(np.asarray(q), P) - TARGET
    return r @ r


def slope(f, q):
    return np.array([f(np.array(q) + 1e-30j * row).imag for row in np.eye(4)]) / 1e-30


def unit(q):
    return slope(unnormalised, q)
