"""Van der Pol by LSODA and sensitivities."""

import numpy as np
from scipy.integrate import solve_ivp

about = {
    "package": "scipy",
    "python": "bench",
    "requires": "scipy",
    "examine": "grad=gradient refined=refined calls=2500",
    "derivative": "right",
    "how": "sensitivities by DOP853 at 1e-12",
    "advice": "The cost of an adaptive solver is rough: differences of it need a tolerance of 1e-10, and `examine` the argument `refined`.",
}
theta = np.array([5.0, 2.0, 0.0])  # mu, first state


def rate(t, z, mu):
    """Return the rates of the state and, if given, of its 2 x 3 derivatives."""
    x, v, s = z[0], z[1], z[2:].reshape(2, -1)
    slopes = np.array([[0, 1], [-2 * mu * x * v - 1, mu * (1 - x * x)]]) @ s if s.size else s
    slopes[1:, :1] += (1 - x * x) * v  # by mu itself
    return np.r_[v, mu * (1 - x * x) * v - x, slopes.ravel()]


def solve(p, more, method, tol):
    """Return the last state and derivatives."""
    return solve_ivp(rate, (0, 12), np.r_[p[1:], more], method, args=(p[0],), rtol=tol, atol=tol / 100).y[:, -1]


def cost(p, tol=1e-6):
    """Return the last speed."""
    return solve(p, [], "LSODA", tol)[1]


def refined(p):
    """Return the cost at a far smaller tolerance."""
    return cost(p, 1e-11)


def gradient(p, method="LSODA", tol=1e-6):
    """Return the derivative, from sensitivities at the same tolerance."""
    return solve(p, [0, 1, 0, 0, 0, 1], method, tol)[5:]


def truth():
    """Return the derivative by another method at a far smaller tolerance."""
    return gradient(theta, "DOP853", 1e-12)
