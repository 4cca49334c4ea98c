"""How gradients of real engines fail, in plain NumPy: adaptive steps, warm starts, shared buffers, shorter floats.

Each function imitates the mechanism of a failure that was found with an engine, so that tests need no engine.
"""

from functools import partial

import numpy as np
from simulators import complex_step, swing

ORDER = 3
TABLE = ((0.5,), (0.0, 0.75), (2 / 9, 1 / 3, 4 / 9))
"""Stages of the method of Bogacki and Shampine (1989, Appl. Math. Lett. 2, 321-325)."""
ERROR = (2 / 9 - 7 / 24, 1 / 3 - 1 / 4, 4 / 9 - 1 / 3, -1 / 8)


def integrate(slope, state, end, rtol):
    """Return the state at time ``end`` of ``d state / dt = slope(*state)``, with steps chosen by an error estimate.

    The steps depend on real parts only, so a complex step gives the derivative with the steps held fixed, as reverse
    mode through an adaptive solver does.
    """
    state, t, dt = tuple(state), 0.0, 0.1
    while t < end:
        dt = min(dt, end - t)
        slopes = [slope(*state)]
        for row in TABLE:
            at = tuple(z + dt * sum(a * k[i] for a, k in zip(row, slopes, strict=True)) for i, z in enumerate(state))
            slopes.append(slope(*at))
        errors = [dt * sum(e * k[i] for e, k in zip(ERROR, slopes, strict=True)).real for i in range(len(state))]
        sizes = [max(abs(a.real), abs(b.real)) for a, b in zip(state, at, strict=True)]
        squares = [(e / (rtol * 1e-2 + rtol * s)) ** 2 for e, s in zip(errors, sizes, strict=True)]
        ratio = np.sqrt(sum(squares) / len(state))
        if ratio <= 1.0:
            t, state = t + dt, at
        dt *= min(5.0, max(0.2, 0.9 / max(ratio, 1e-10) ** (1 / ORDER)))
    return state


def adaptive(x, rtol=1e-4, end=3.0):
    """Return y(end)^2 + v(end) of van der Pol's equation, by steps that adapt to theta, as in dopri5.

    theta is damping, first position and first speed.
    """
    y, v = integrate(lambda y, v: (v, x[0] * (1 - y * y) * v - y), x[1:], end, rtol)
    return y * y + v


def separate(x, rtol=1e-4, end=3.0, forgotten=0.0):
    """Return the gradient of :func:`adaptive` by the adjoint equation, which is solved backward with steps of its own.

    The position is solved backward too, as ``odeint_adjoint`` of torchdiffeq does. ``forgotten`` is the share of a term
    of the adjoint equation that is left out.
    """
    y, v = integrate(lambda y, v: (v, x[0] * (1 - y * y) * v - y), x[1:], end, rtol)

    def backward(y, v, by_y, by_v, by_x):
        slope = x[0] * (1 - y * y) * v - y
        return (
            -v,
            -slope,
            -by_v * (2 * x[0] * y * v * (1 - forgotten) + 1),
            by_y + by_v * x[0] * (1 - y * y),
            by_v * (1 - y * y) * v,
        )

    _, _, by_y, by_v, by_x = integrate(backward, (y, v, 2 * y, 1.0, 0.0), end, rtol)
    return np.array([by_x, by_y, by_v])


def frozen(x, **settings):
    """Return the derivative of :func:`adaptive` with its steps held fixed."""
    return complex_step(partial(adaptive, **settings))(x)


def refined(x):
    return adaptive(x, rtol=1e-9)


class WarmStarted:
    """A cost by a solver that starts from its last solution, and stops at a tolerance."""

    def __init__(self, tolerance=1e-6):
        self.tolerance, self.z = tolerance, 0.0

    def cost(self, x):
        before = np.inf
        while abs(self.z - before) > self.tolerance:
            before, self.z = self.z, np.cos(self.z) * x[0] * x[1] / 3
        return self.z**2

    @staticmethod
    def gradient(x):
        z, c = 0.5, x[0] * x[1] / 3
        for _ in range(200):
            z = np.cos(z) * c
        return 2 * z * np.cos(z) / 3 * np.array([x[1], x[0]]) / (1 + np.sin(z) * c)


def swinging(x, steps=20, shared=False, slope=False):
    """Return the cost of a pendulum, or its reverse-mode gradient by angle and speed.

    ``shared`` stores the angle of every step in one place, as a solver does whose matrices every step overwrites: the
    backward pass then reads the last one.
    """
    dt, q, v = 0.05, x[0], x[1]
    tape = []
    for _ in range(steps):
        tape.append(q)
        v = v - dt * 9.81 * np.sin(q)
        q = q + dt * v
    if not slope:
        return q * q
    dq, dv = 2 * q, 0.0
    for angle in reversed(tape):
        dv = dv + dt * dq
        dq = dq - dt * 9.81 * np.cos(tape[-1] if shared else angle) * dv
    return np.array([dq, dv])


def single(x, is_mixed=False):
    """Return a float32 rollout's cost as a Python float, as ``float(loss.numpy()[0])`` does.

    With ``is_mixed`` only the states are float32, and the cost is computed from them in float64.
    """
    q, v, dt = np.float32(x[0]), np.float32(x[1]), np.float32(0.02)
    for _ in range(40):
        v = v - dt * np.float32(9.81) * np.sin(q)
        q = q + dt * v
    if is_mixed:
        return float(q) ** 2 + 0.1 * float(v) ** 2
    return float(q * q + np.float32(0.1) * v * v)


def single_gradient(x):
    """Return the derivative of :func:`single` in double precision."""
    return complex_step(lambda x: swing([*x, 0.0], steps=40))(x)
