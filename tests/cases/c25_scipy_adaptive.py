"""A ball on a damped spring by SciPy's adaptive RK45 at rtol 1e-6, with sensitivities that miss the jump of force at touch-down.

The damper acts from the first contact on, so sensitivities need a jump there, which ``gradient`` leaves out. The derivative is
(.413505, -.036766, 4.2117e-6): by a closed form of flights and contacts, and by differences of ``fine``. Right to .2% for the
first two, the third of the wrong sign: WRONG, also with ``refined=fine``. ``exact`` is the derivative, by differences of
``fine``: RIGHT with ``refined=fine``, never WRONG without. ``forgets`` drops the damper's effect as well: WRONG.

Differences of ``cost`` at steps below 1e-3 are a real slope of the step-size control: 1.36 for .4135, +.23 for -.0368.
"""

import numpy as np
from scipy.integrate import solve_ivp

theta = [0.5, -1.0, 2000.0]
M, D, G, T = 0.2, 0.5, 9.81, 0.6


def rhs(t, y, k):
    z, v = y[:2]
    c = z < 0
    f = (-k * z - D * v) * c
    return np.array([v, -G + f / M])


def rhs_s(t, y, k, damping=D):
    z, _ = y[:2]
    c = float(z < 0)
    S = y[2:].reshape(2, 3)
    A = np.array([[0, 1], [-k * c / M, -damping * c / M]])
    B = np.zeros((2, 3))
    B[1, 2] = -z * c / M
    return np.concatenate([rhs(t, y, k), (A @ S + B).ravel()])


def cost(x, rtol=1e-6, atol=1e-9):
    s = solve_ivp(rhs, (0, T), [x[0], x[1]], args=(x[2],), rtol=rtol, atol=atol)
    return (s.y[0, -1] - 0.3) ** 2


def fine(x):
    return cost(x, 1e-12, 1e-14)


def exact(x):
    moves = 1e-4 * np.abs(x) * np.eye(3)
    return np.array([(fine(x + move) - fine(x - move)) / (2 * move.max()) for move in moves])


def gradient(x, rtol=1e-6, atol=1e-9, damping=D):
    start = np.array([x[0], x[1], 1, 0, 0, 0, 1, 0])
    y = solve_ivp(rhs_s, (0, T), start, args=(x[2], damping), rtol=rtol, atol=atol).y[:, -1]
    return 2 * (y[0] - 0.3) * y[2:5]


def forgets(x):
    return gradient(x, 1e-9, 1e-12, damping=0.0)
