"""patrick-kidger/diffrax#596: BacksolveAdjoint on a dissipative ODE: the state rebuilt backwards drifts off. Right: discrete adjoint (exact), against complex step."""

import numpy as np

theta = [3.0, 0.8]
H = 0.05


def f(y, x):
    return -x[0] * (y**3 + y - x[1])


def rk4(y, x, h):
    a = f(y, x)
    b = f(y + h / 2 * a, x)
    c = f(y + h / 2 * b, x)
    d = f(y + h * c, x)
    return y + h / 6 * (a + 2 * b + 2 * c + d)


def cost(x, steps=20):
    y = 2.0
    for _ in range(steps):
        y = rk4(y, x, H)
    return float(np.real(y) ** 2)


def exact(x, steps=20):
    g = []
    for i in range(2):
        z = np.asarray(x, float).astype(complex)
        z[i] += 1e-30j
        y = 2.0
        for _ in range(steps):
            y = rk4(y, z, H)
        g.append(float(np.imag(y**2) / 1e-30))
    return g


def backsolve(x, steps=20):
    y = 2.0
    for _ in range(steps):
        y = rk4(y, x, H)

    def F(s):
        y, a = s[0], s[1]
        return np.array([f(y, x), a * x[0] * (3 * y * y + 1), a * (y**3 + y - x[1]), -a * x[0]])

    s = np.array([y, 2 * y, 0.0, 0.0])
    h = -H
    with np.errstate(all="ignore"):
        for _ in range(steps):
            a = F(s)
            b = F(s + h / 2 * a)
            c = F(s + h / 2 * b)
            d = F(s + h * c)
            s = s + h / 6 * (a + 2 * b + 2 * c + d)
    return [s[2], s[3]]
