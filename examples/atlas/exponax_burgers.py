"""Burgers' equation in float32, as JAX computes by default."""

import exponax
import jax.numpy as jnp
import numpy as np

about = {
    "package": "exponax",
    "python": "jax",
    "requires": "exponax",
    "examine": "grad=jax calls=1500",
    "derivative": "right",
    "how": "differences, own ETDRK2 scheme in float64",
}
N, DT = 128, 0.01
X = np.linspace(0, 1, N, endpoint=False)
theta = np.array([1.0, 0.2, 0.01])  # amplitude, phase, viscosity


def cost(p, steps=50):
    """Return the mean of a part of the last state."""
    step = exponax.stepper.Burgers(1, 1.0, N, DT, diffusivity=p[2])
    return jnp.mean(exponax.repeat(step, steps)(p[0] * jnp.sin(2 * jnp.pi * X + p[1])[None])[:, 20:40])


def own(p):
    """Return the cost in float64."""
    n = np.fft.fftfreq(N, 1 / N)
    k, mask = 2j * np.pi * n, abs(n) <= N // 3
    power = DT * p[2] * (k**2).real
    z = np.exp(2j * np.pi * (np.arange(1, 65) - 0.5) / 64)[:, None] + power
    first, second = (DT * np.mean(f, 0).real for f in ((np.exp(z) - 1) / z, (np.exp(z) - 1 - z) / z**2))
    bend = lambda v: -np.fft.fft(np.fft.ifft(v * mask).real * np.fft.ifft(k * v * mask).real) * mask
    v = np.fft.fft(p[0] * np.sin(2 * np.pi * X + p[1]))
    for _ in range(50):
        old = bend(v)
        v = np.exp(power) * v + first * old
        v = v + second * (bend(v) - old)
    return np.mean(np.fft.ifft(v).real[20:40])


def truth():
    """Return the derivative of the own scheme."""
    return [(own(theta + e) - own(theta - e)) / 2e-5 for e in 1e-5 * np.eye(3)]
