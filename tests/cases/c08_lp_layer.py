"""cvxpylayers #127: derivative of a linear program's solution, which sits at a vertex, from an interior-point solver.

Portfolio: maximise x.w on the simplex; cost = -true.w*(x). w* is a vertex, so the cost is constant between switches.
RIGHT: derivative exactly 0 at theta; under noise N(0, sigma^2 I) grad J is not 0: J = -sum_i true_i P(x_i + noise is the
largest), by quadrature (``smoothed``). ``layer`` returns the solver's leftovers of 1e-8 (barrier mu = 1e-8).
"""

import numpy as np

theta = [0.1, 0.2, -0.1]
TRUE = np.array([-0.1, -0.1, 0.5])


def cost(x):
    return -TRUE[int(np.argmax(x))]


def layer(x, mu=1e-8):
    """Solution w = softmax-like interior point: derivative of the barrier path at mu, of order mu / gap^2."""
    x = np.array(x, float)
    low, high = x.max() + 1e-12, x.max() + 4 * mu
    for _ in range(200):
        mid = (low + high) / 2
        low, high = (mid, high) if np.sum(mu / (mid - x)) > 1 else (low, mid)
    w = mu / (mid - x)
    s = w * w / mu
    return -(np.diag(s) - np.outer(s, s) / s.sum()) @ TRUE
