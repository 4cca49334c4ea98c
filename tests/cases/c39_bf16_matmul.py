"""google-deepmind/mujoco#1182, Andrew-Luo1/jax_shac#1: backward pass at the default matmul precision (bfloat16 products). Right: the same adjoint in float64."""

import numpy as np

theta = [0.4, -0.3]
R = np.array([[1.0, 0.1], [-0.35, 0.98]])


def _bf(a):
    u = np.asarray(a, np.float32).view(np.uint32)
    return ((u + 0x7FFF + ((u >> 16) & 1)) & 0xFFFF0000).astype(np.uint32).view(np.float32).astype(float)


def _roll(x, n):
    s = np.array([x[0], x[1]], float)
    h = [s]
    for _ in range(n):
        s = R @ s + 0.2 * np.sin(2 * s)
        h.append(s)
    return h


def cost(x, steps=30):
    return float(np.sum(_roll(x, steps)[-1] ** 2))


def _g(x, n, q):
    h = _roll(x, n)
    a = 2 * h[-1]
    for s in reversed(h[:-1]):
        a = q(R.T) @ q(a) + q(0.4 * np.cos(2 * s)) * q(a)
    return a


def double(x, steps=30):
    return _g(x, steps, lambda v: v)


def low(x, steps=30):
    return _g(x, steps, _bf)
