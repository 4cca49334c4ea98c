"""The fixed point of a network, differentiated implicitly."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix

jax.config.update("jax_enable_x64", True)
about = {
    "package": "optimistix",
    "python": "bench",
    "requires": "optimistix",
    "examine": "grad=jax sigma=0.1 calls=3000",
    "derivative": "right",
    "use": "usable",
    "how": "own iteration",
}
theta = np.array([0.3, -0.5, 0.8, 0.1])
WEIGHTS = 0.3 * np.random.default_rng(0).standard_normal((4, 4))
SOLVER = optimistix.Newton(rtol=1e-10, atol=1e-10)


def cost(p):
    """Return the squared norm of z = tanh(W z + p)."""
    residual = lambda z, p: z - jnp.tanh(WEIGHTS @ z + p)
    return jnp.sum(optimistix.root_find(residual, SOLVER, jnp.zeros(4), p).value ** 2)


def truth():
    """Return the derivative of the iterated network."""
    z = np.zeros((4, 4))
    for _ in range(200):
        z = np.tanh(WEIGHTS @ z + theta[:, None] + 1e-30j * np.eye(4))
    return np.sum(z**2, 0).imag / 1e-30
