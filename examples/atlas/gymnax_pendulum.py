"""A pendulum for 50 steps, with transition gradients."""

import gymnax
import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
about = {
    "package": "gymnax",
    "python": "jax",
    "requires": "gymnax",
    "examine": "grad=jax calls=2000",
    "derivative": "right",
    "how": "the published equations",
}
theta = np.sin(np.arange(50.0))
plain, usual = gymnax.make("Pendulum-v1")
env = plain.with_transition_gradients()


def cost(p, env=env):
    """Return minus the sum of rewards."""
    state = env.reset(jax.random.key(0), usual)[1].replace(theta=jnp.asarray(1.0), theta_dot=jnp.asarray(0.5))
    step = lambda s, u: env.step_env(jax.random.key(0), s, u[None], usual)[1:3]
    return -jnp.sum(jax.lax.scan(step, state, p)[1])


def truth():
    """Return the derivative by all torques together; angles stay within a turn."""
    a, v, total = 1.0 + 0j, 0.5 + 0j, 0.0
    for u in theta[:, None] + 1e-30j * np.eye(50):
        total = total + ((a.real + np.pi) % (2 * np.pi) - np.pi + 1j * np.imag(a)) ** 2 + 0.1 * v**2 + 0.001 * u**2
        v = v + 0.05 * (15 * np.sin(a) + 3 * u)
        a = a + 0.05 * v
    return total.imag / 1e-30
