"""A double well with noise, by Heun."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
about = {
    "package": "diffrax",
    "python": "jax",
    "requires": "diffrax",
    "examine": "grad=jax calls=1000",
    "derivative": "right",
    "how": "own Heun scheme of the same increments",
}
theta, KEYS = np.array([1.0, 1.0, 0.4]), jax.random.split(jax.random.key(0), 16)  # slopes of the well, noise


def tree(key):
    """Return the Brownian motion of a key."""
    return diffrax.VirtualBrownianTree(0.0, 4.0, tol=1e-3, shape=(), key=key)


def path(p, key):
    """Return the last position on one path."""
    drift = diffrax.ODETerm(lambda t, y, a: a[0] * y - a[1] * y**3)
    terms = diffrax.MultiTerm(drift, diffrax.ControlTerm(lambda t, y, a: a[2], tree(key)))
    return diffrax.diffeqsolve(terms, diffrax.Heun(), 0.0, 4.0, 0.01, 0.1, args=p).ys[0]


def cost(p):
    """Return the mean squared position."""
    return jnp.mean(jax.vmap(path, (None, 0))(p, KEYS) ** 2)


def truth():
    """Return the derivative of the mean along the same paths."""
    times = np.minimum(0.01 * np.arange(401), 4.0)
    w = np.array(jax.jit(jax.vmap(lambda key: jax.vmap(tree(key).evaluate)(times)))(KEYS))
    a, b, s = (theta + 1e-30j * np.eye(3)).T[:, :, None]
    y = 0.1 + 0j
    for dw in np.diff(w).T:
        slope, guess = a * y - b * y**3, y + 0.01 * (a * y - b * y**3) + s * dw
        y = y + 0.005 * (slope + a * guess - b * guess**3) + s * dw
    return np.mean(y**2, axis=1).imag / 1e-30
