"""jax-ml/jax 3024, dm_pix PR 126: linear interpolation by floor and ceil has derivative 0 at a node. RIGHT: .25 (affine ramp)."""

import jax.numpy as jnp

theta = [1.0]
RAMP = jnp.array([0.0, 0.25, 0.5, 0.75, 1.0])


def at(x, upper):
    lo = jnp.floor(x)
    hi = upper(lo, x)
    w = x - lo
    return (1 - w) * RAMP[lo.astype(int)] + w * RAMP[jnp.clip(hi.astype(int), 0, 4)]


def cost(t):
    lo, hi = jnp.floor(t[0]), jnp.ceil(t[0])
    return (
        (hi - t[0]) * RAMP[lo.astype(int)]
        + (t[0] - lo) * RAMP[hi.astype(int)]
        + jnp.where(lo == hi, RAMP[lo.astype(int)], 0.0)
    )


def fixed(t):
    return at(t[0], lambda lo, x: lo + 1)
