"""Isaac Sim #839, warp #471, brax #186: a stiff smoothed friction makes the gradient explode while the rollout is finite.

Two coupled joints with friction -mu tanh(100 v), explicit steps too long for the slope (dt mu 100 = 5): |1 - 5| per step near
v = 0. RIGHT: the derivative at theta (mpmath, 400 digits) is (0.0677077814, -0.1130267855); grad J at sigma = 0.003 is
(0.06447, -0.07173) +- 1e-4 (2e6 antithetic pairs), while single gradients reach 1e3 and more: not usable.
"""

import jax
import jax.numpy as jnp

jax.config.update("jax_enable_x64", True)
theta = [0.3, 1.0]  # friction mu, stiffness


def cost(x, steps=120, dt=1.0 / 60):
    q, v = jnp.array([0.3, -0.2]), jnp.array([0.1, 0.4])

    def body(_, s):
        q, v = s
        a = -x[1] * 40 * q + 6 * jnp.sin(q[::-1]) - 10 * x[0] * jnp.tanh(100 * v)
        v = v + dt * a
        return q + dt * v, v

    q, v = jax.lax.fori_loop(0, steps, body, (q, v))
    return jnp.sum((q - 0.1) ** 2) + 0.01 * jnp.sum(v * v)
