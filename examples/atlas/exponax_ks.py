"""Kuramoto-Sivashinsky on 64 points, by the first state."""

import exponax
import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
about = {
    "package": "exponax",
    "python": "jax",
    "requires": "exponax",
    "examine": "grad=jax horizons=50,200,800 calls=2500",
    "derivative": "right",
    "how": "own ETDRK2 scheme and its tangent",
    "advice": "Chaotic: the right gradient grows about 1,000 times from 200 to 800 steps, so keep rollouts short.",
}
N, L, DT = 64, 60.0, 0.1
X = np.linspace(0, L, N, endpoint=False)
theta = np.sin(2 * np.pi * X / L) + 0.3 * np.cos(6 * np.pi * X / L)
STEP = exponax.stepper.KuramotoSivashinskyConservative(1, L, N, DT)


def cost(u, steps=100):
    """Return the mean square of the last state."""
    return jnp.mean(exponax.repeat(STEP, steps)(u[None]) ** 2)


def truth():
    """Return the derivative, all components together."""
    n = np.fft.fftfreq(N, 1 / N)
    k = 2 * np.pi / L * n
    power, mask = DT * (k**2 - k**4), abs(n) <= N // 3 - 1
    z = np.exp(2j * np.pi * (np.arange(1, 65) - 0.5) / 64)[:, None] + power
    first, second = (DT * np.mean(f, 0).real for f in ((np.exp(z) - 1) / z, (np.exp(z) - 1 - z) / z**2))
    bend = lambda v, w: -0.5j * k * mask * np.fft.fft(np.fft.ifft(v * mask) * np.fft.ifft(w * mask))
    v, w = np.fft.fft(theta), np.fft.fft(np.eye(N))
    for _ in range(100):
        old, slope = bend(v, v), 2 * bend(v, w)
        v, w = np.exp(power) * v + first * old, np.exp(power) * w + first * slope
        v, w = v + second * (bend(v, v) - old), w + second * (2 * bend(v, w) - slope)
    return 2 * np.mean((np.fft.ifft(v) * np.fft.ifft(w)).real, 1)
