"""warp #1697: the adjoint of v[i] = v[i] + x on a local vector adds the incoming adjoint twice; it compounds over steps.

A chain of 4 masses with a spring law; each step accumulates two contributions into a local force vector. ``doubled`` is the
handwritten reverse pass with that fault, right after one step's smooth part but growing with T. RIGHT: complex step.
Use with horizons=1,2,5,10,20.
"""

import numpy as np

theta = [0.3, -0.2, 0.1, 0.4]
DT, K = 0.05, 4.0


def cost(x, steps=20):
    q, v = np.asarray(x) * 1, np.zeros(4)
    for _ in range(steps):
        f = np.zeros(4, dtype=q.dtype)
        f = f - K * np.sin(q)
        f = f + 0.5 * (np.roll(q, 1) - q)
        v = v + DT * f
        q = q + DT * v
    return np.sum(q * q) + 0.1 * np.sum(v * v)


def reverse(x, steps=20, factor=1.0):
    q, v, tape = np.array(x, float), np.zeros(4), []
    for _ in range(steps):
        tape.append(q)
        v = v + DT * (-K * np.sin(q) + 0.5 * (np.roll(q, 1) - q))
        q = q + DT * v
    dq, dv = 2 * q, 0.2 * v
    for q in reversed(tape):
        dv = dv + DT * dq
        df = DT * dv
        second = df  # adjoint after the second accumulation
        first = factor * df  # the fault: the read-modify-write passes its adjoint on twice
        dq = dq - K * np.cos(q) * first + 0.5 * (np.roll(second, -1) - second)
    return dq


def doubled(x, steps=20):
    return reverse(x, steps, 2.0)
