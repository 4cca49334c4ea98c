"""pytorch #47599, jax #2311: gradient through eigenvectors of a repeated eigenvalue, where the loss needs only the subspace.

A(x) has eigenvalues (x0, x1, x1, x2, x2) in fixed directions. Cost: trace of W on the subspace of x1, plus x1^2.
RIGHT: the subspace does not depend on x, so d/dx = (0, 2 x1, 0) exactly (closed form). autograd divides by
lambda_i - lambda_j of about 1e-16 and returns garbage or NaN, differently at each rounding.
"""

import numpy as np
import torch

rng = np.random.default_rng(1)
P = torch.tensor(np.linalg.qr(rng.standard_normal((5, 5)))[0])
W = torch.tensor(rng.standard_normal((5, 5)))
theta = [0.5, 1.0, 2.0]


def cost(x):
    a = torch.stack([x[0], x[1], x[1], x[2], x[2]])
    matrix = (P.T * a) @ P
    values, vectors = torch.linalg.eigh(matrix)
    u = vectors[:, 1:3]
    return torch.einsum("rc,rc->", W @ u, u) + values[1] * values[2]
