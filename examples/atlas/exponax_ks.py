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
    "how": "complex step, own ETDRK2 scheme",
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
    bend = lambda v: -0.5j * k * mask * np.fft.fft(np.fft.ifft(v * mask) ** 2)
    v = np.fft.fft(theta + 1e-30j * np.eye(N))
    for _ in range(100):
        guess = np.exp(power) * v + first * bend(v)
        v = guess + second * (bend(guess) - bend(v))
    return np.mean(np.fft.ifft(v) ** 2, 1).imag / 1e-30
