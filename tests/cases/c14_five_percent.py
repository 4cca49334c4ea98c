"""mosaic #158: adjoint of a finite-element heat source 5% off at every step of the differences.

Poisson on 24 linear elements with end values 0, source nodal values theta (23 numbers), cost = u.u. The forward uses the
consistent load matrix; the adjoint multiplies by a lumped one on the boundary-adjacent rows. RIGHT: B^T A^-T 2u (closed
form, linear). Ratios are 0.95 for 21 components and 1.318 for the two at the ends.
"""

import numpy as np

N = 24
H = 1.0 / N
A = (np.diag(np.full(N - 1, 2.0)) - np.diag(np.ones(N - 2), 1) - np.diag(np.ones(N - 2), -1)) / H
B = H * (np.diag(np.full(N - 1, 4.0)) + np.diag(np.ones(N - 2), 1) + np.diag(np.ones(N - 2), -1)) / 6
theta = list(1 + np.sin(np.arange(1, N)))
WRONG = B * 0.95
WRONG[0, 0] = WRONG[-1, -1] = H


def cost(x):
    u = np.linalg.solve(A, B @ np.asarray(x))
    return u @ u


def adjoint(x):
    return WRONG.T @ np.linalg.solve(A.T, 2 * np.linalg.solve(A, B @ np.asarray(x)))
