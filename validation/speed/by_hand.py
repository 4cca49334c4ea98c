"""`pushing` as a user would write it for one library, with the penalty spring and semi-implicit Euler.

Costs and gradients are functions of ``theta (T,)`` and ``w (T, B)`` in NumPy arrays.
"""

from functools import partial

import numpy as np


def jax_cost(scene):
    """Return the cost of one rollout as a function of the stiffness, ``theta (T,)`` and ``w (T,)``."""
    import jax
    import jax.numpy as jnp

    def cost(stiffness, theta, w):
        def step(carry, u):
            total, state = carry
            return (total + _distance(scene, *state) + u * u, _move(scene, stiffness, jnp.maximum, state, u)), None

        first = (0.0, (0.0, 1.0, scene.speed, 0.0))
        (total, last), _ = jax.lax.scan(step, first, theta + scene.sigma * w)
        return total + _distance(scene, *last)

    return cost


def jax_gradient(scene, stiffness):
    """Return the gradient ``(T, B)`` by ``jit(vmap(grad(scan)))``."""
    import jax

    gradient = jax.jit(jax.vmap(jax.grad(partial(jax_cost(scene), stiffness)), in_axes=(None, 1), out_axes=1))
    return lambda theta, w: np.asarray(gradient(theta, w))


def torch_gradient(scene, stiffness):
    """Return the gradient ``(T, B)`` by autograd through a Python loop."""
    import torch

    def gradient(theta, w):
        full = torch.from_numpy(theta)[:, None].repeat(1, w.shape[1]).requires_grad_()
        controls = full + scene.sigma * torch.from_numpy(w)
        _cost(scene, stiffness, lambda x, _: torch.relu(x), controls, torch.zeros_like(controls[0])).sum().backward()
        return full.grad.numpy()

    return gradient


def numpy_cost(scene, stiffness):
    """Return the costs ``(B,)`` by a Python loop."""

    def cost(theta, w):
        controls = theta[:, None] + scene.sigma * w
        return _cost(scene, stiffness, np.maximum, controls, np.zeros_like(controls[0]))

    return cost


def _cost(scene, stiffness, maximum, controls, zero):
    total, state = zero, (zero, zero + 1.0, zero + scene.speed, zero)
    for u in controls:
        total = total + _distance(scene, *state) + u * u
        state = _move(scene, stiffness, maximum, state, u)
    return total + _distance(scene, *state)


def _move(scene, stiffness, maximum, state, u):
    """Return the state after a step from (x1, x2, v1, v2) under the force u."""
    x1, x2, v1, v2 = state
    h, h_over_m, c = scene.dt, scene.dt / scene.mass, scene.velocity_factor
    force = stiffness * maximum(x1 + 1.0 - x2, 0.0)
    after = c * v1 + h_over_m * (u - force), c * v2 + h_over_m * force
    return x1 + h * after[0], x2 + h * after[1], *after


def _distance(scene, x1, x2, v1, v2):
    return 0.1 * (x1 - 1.0) ** 2 + 10.0 * (x2 - 2.0) ** 2 + 0.1 * (v1 - scene.speed) ** 2 + 0.1 * v2**2
