"""jax-gcm #558: reverse mode is finite for one step and NaN from the second; forward and differences are finite.

Shear of a column at rest: one step gives a nonzero wind only after the first, and the mixing length uses
where(shear > 0, sqrt(shear), 0). RIGHT: the same cost with the double where,
whose gradient is finite at every T. Use with horizons=1,2,3.
"""

import jax
import jax.numpy as jnp

jax.config.update("jax_enable_x64", True)
theta = [300.0, 0.5]


def model(x, steps, root):
    u = jnp.zeros(4)
    t = jnp.linspace(0.0, 1.0, 4) * x[1] + x[0] * 1e-2
    for _ in range(steps):
        shear = jnp.diff(u) ** 2
        k = 0.1 * root(shear)
        flux = k * jnp.diff(t)
        t = t + jnp.pad(flux, (0, 1)) - jnp.pad(flux, (1, 0))
        u = u + 0.05 * jnp.array([0.0, 0.0, 1.0, 1.0]) * t * t
    return jnp.sum((t - 2.0) ** 2)


def plain(s):
    return jnp.where(s > 0, jnp.sqrt(s), 0.0)


def cost(x, steps=3):
    return model(x, steps, plain)


def grad(x, steps=3):
    return jax.grad(lambda y: cost(y, steps))(jnp.asarray(x, float))
