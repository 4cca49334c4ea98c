"""A FitzHugh-Nagumo neuron by `odeint` (RK4), by its four parameters."""

import brainpy as bp
import brainpy.math as bm
import jax
import numpy as np

bm.enable_x64()
about = {
    "package": "brainpy",
    "python": "jax",
    "requires": "brainpy",
    "examine": "grad=jax calls=2000",
    "derivative": "right",
    "how": "own RK4",
}
theta = np.array([0.7, 0.8, 0.08, 0.5])  # a, b, rate, current


def rates(v, w, p):
    """Return the rates of voltage and recovery."""
    return v - v**3 / 3 - w + p[3], p[2] * (v + p[0] - p[1] * w)


equations = bp.JointEq(lambda v, t, w, p: rates(v, w, p)[0], lambda w, t, v, p: rates(v, w, p)[1])
solver = bp.odeint(equations, method="rk4", dt=0.1)


def cost(p):
    """Return the voltage after 40 units of time."""
    return jax.lax.scan(lambda s, _: (tuple(solver(*s, 0.0, p=p)), None), (-1.0, 1.0), None, 400)[0][0]


def truth():
    """Return the derivative along an own solution."""
    p, y = (theta + 1e-30j * np.eye(4)).T, np.array([[-1.0], [1.0]])
    f = lambda y: np.array(rates(*y, p))
    for _ in range(400):
        a = f(y)
        b = f(y + 0.05 * a)
        c = f(y + 0.05 * b)
        y = y + 0.1 / 6 * (a + 2 * b + 2 * c + f(y + 0.1 * c))
    return y[0].imag / 1e-30
