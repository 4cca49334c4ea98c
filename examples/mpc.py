"""Weights of a predictive controller on a cart-pole, learned through its quadratic program with limited forces."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

jax.config.update("jax_enable_x64", True)
STEPS, DT, LIMIT = 12, 0.1, 5.0  # x = (position, angle, their rates), linearised at upright: 1 kg, 0.1 kg, 0.5 m
A = np.eye(4) + DT * np.array([[0, 0, 1, 0], [0, 0, 0, 1], [0, -0.981, 0, 0], [0, 21.582, 0, 0]])
POWERS = [np.linalg.matrix_power(A, k) for k in range(STEPS + 1)]
PUSHED = [
    [POWERS[i - j] @ [[0], [0], [DT], [-2 * DT]] if j <= i else np.zeros((4, 1)) for j in range(STEPS)]
    for i in range(STEPS)
]
FREE, FORCED = np.concatenate(POWERS[1:]), np.block(PUSHED)  # states after 1 to 12 steps = FREE x + FORCED u
STARTS = np.random.default_rng(0).uniform(-1, 1, (16, 4)) * [1.0, 0.2, 0.5, 0.5]


def plan(theta, start, by_limits=True):
    """Return the forces of smallest sum of exp(theta) . x^2 + 0.1 u^2; `by_limits=False` differentiates without limits."""
    weighted = jnp.tile(jnp.exp(theta), STEPS)[:, None] * FORCED
    h, g = weighted.T @ FORCED + 0.1 * jnp.eye(STEPS), weighted.T @ FREE @ start
    fixed = jax.lax.stop_gradient(h)

    def newton(u, free, slope):  # for the forces that are free to move
        return jnp.linalg.solve(jnp.where(free & free[:, None], fixed, jnp.eye(STEPS)), jnp.where(free, slope, 0.0))

    def improve(u, _):  # the best of ten step lengths, cut at the limits
        free = (abs(u) < LIMIT) | (u * (h @ u + g) > 0)
        tries = jnp.clip(u - 0.5 ** jnp.arange(10.0)[:, None] * newton(u, free, h @ u + g), -LIMIT, LIMIT)
        return tries[jnp.argmin(((tries @ h) * tries).sum(axis=1) / 2 + tries @ g)], None

    u = jax.lax.stop_gradient(jax.lax.scan(improve, jnp.zeros(STEPS), None, 30)[0])
    moved = h @ u + g  # optimality of the free forces: h u + g = 0, with the others at a limit (Amos et al. 2018)
    return u - newton(u, (abs(u) < LIMIT) | (not by_limits), moved - jax.lax.stop_gradient(moved))


EXPERT = jax.vmap(plan, (None, 0))(jnp.log(jnp.array([1.0, 10.0, 0.1, 0.5])), STARTS)


def cost(theta, by_limits=True):
    """Return the mean squared distance of the planned forces from the expert's."""
    return jnp.mean((jax.vmap(plan, (None, 0, None))(theta, STARTS, by_limits) - EXPERT) ** 2)


def without_limits(theta):
    """Return the same cost, with the planted fault: its derivative ignores which forces are at a limit."""
    return cost(theta, by_limits=False)


if __name__ == "__main__":
    import bench

    learned = minimize(jax.jit(jax.value_and_grad(cost)), np.zeros(4), jac=True).x
    print("learned weights:", np.exp(learned).round(3), end="\n\n")
    for function in (cost, without_limits):
        print(bench.examine(function, np.zeros(4), grad="jax", sigma=[0.03], budget="60s"), end="\n\n")
