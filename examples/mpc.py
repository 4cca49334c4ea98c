"""Weights of a predictive controller for a cart-pole, learned through its quadratic program (Amos et al. 2018)."""

import jax
import jax.numpy as jnp
from scipy.optimize import minimize

jax.config.update("jax_enable_x64", True)
STEPS, LIMIT, stop = 12, 3.0, jax.lax.stop_gradient  # near upright; states (position, angle, rates) at steps of 0.1 s
A = jnp.eye(4) + 0.1 * jnp.array([[0, 0, 1, 0], [0, 0, 0, 1], [0, -0.981, 0, 0], [0, 21.582, 0, 0]])
PATH = jnp.linalg.inv(jnp.eye(4 * STEPS) - jnp.kron(jnp.eye(STEPS, k=-1), A))  # states = FORCED forces + FREE start
FORCED, FREE = PATH @ jnp.kron(jnp.eye(STEPS), jnp.array([[0.0], [0.0], [0.1], [-0.2]])), PATH[:, :4] @ A
STARTS = jax.random.uniform(jax.random.key(0), (16, 4), minval=-1.0) * jnp.array([1.0, 0.2, 0.5, 0.5])


def plan(theta, start, by_limits=True):
    """Return the forces of smallest sum of exp(theta) . state^2 + 0.1 force^2 with abs(force) <= LIMIT."""
    h, g = (w := FORCED.T * jnp.tile(jnp.exp(theta), STEPS)) @ FORCED + 0.1 * jnp.eye(STEPS), w @ FREE @ start

    def newton(free, slope):  # the step of the forces that are free to move
        return jnp.linalg.solve(jnp.where(free & free[:, None], stop(h), jnp.eye(STEPS)), jnp.where(free, slope, 0.0))

    def improve(u, _):  # the best of ten lengths of the step, cut at the limits
        step = newton((abs(u) < LIMIT) | (u * (h @ u + g) > 0), h @ u + g)
        tries = jnp.clip(u - 0.5 ** jnp.arange(10.0)[:, None] * step, -LIMIT, LIMIT)
        return tries[jnp.argmin(((tries @ h) * tries).sum(axis=1) / 2 + tries @ g)], None

    u = stop(jax.lax.scan(improve, jnp.zeros(STEPS), None, 30)[0])  # free forces have h u + g = 0 also at other theta
    return u - newton((abs(u) < LIMIT) | (not by_limits), h @ u + g - stop(h @ u + g))


def cost(theta, by_limits=True):
    """Return the squared distance from an expert's forces; `by_limits=False` has a wrong derivative: no limits."""
    return jnp.mean(jax.vmap(lambda x: plan(theta, x, by_limits) - plan(jnp.array([0, 2, -2, -1.0]), x))(STARTS) ** 2)


if __name__ == "__main__":
    import bench

    print(bench.examine(cost, jnp.zeros(4), grad="jax", budget="60s"), end="\n\nlearned log-weights: ")
    print(minimize(jax.jit(jax.value_and_grad(cost)), jnp.zeros(4), jac=True).x)
