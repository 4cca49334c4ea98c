"""Steps of networks by optax: learning rates that fall linearly, the log of a step, and passes over shuffled batches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from bench.errors import UserError
from bench.model.ops import Array


def adam(rate: float, updates: int, clip: float, beta1: float, beta2: float) -> optax.GradientTransformation:
    """Return Adam with a norm clipped at ``clip``, and a rate that falls linearly to 1e-5 over ``updates`` steps."""
    # learning rate at the end of a run (Xu et al. 2022, public configuration)
    schedule = optax.linear_schedule(rate, min(1e-5, rate), updates)
    return optax.chain(optax.clip_by_global_norm(clip), optax.adam(schedule, b1=beta1, b2=beta2))


def step_log(gradient: Any, change: Any, parameters: Any) -> dict[str, Array]:
    """Return norm and largest entry of a gradient, norm of the change, and the largest parameter."""
    largest = [jnp.stack([jnp.abs(x).max() for x in jax.tree.leaves(tree)]).max() for tree in (gradient, parameters)]
    return {
        "gradient_norm": optax.tree.norm(gradient),
        "gradient_largest": largest[0],
        "step_length": optax.tree.norm(change),
        "parameter_largest": largest[1],
    }


def batches_of(key: Array, count: int, passes: int, batches: int) -> Array:
    """Return the columns of each batch, ``(passes * batches, count // batches)``: a new order of all in each pass."""
    if batches > count:
        raise UserError(
            f"batches = {batches}, but a window has {count} states (rollouts times steps): each batch needs at least one"
        )
    size = count // batches
    orders = jax.vmap(lambda k: jax.random.permutation(k, count)[: batches * size])(jax.random.split(key, passes))
    return orders.reshape(passes * batches, size)


def fit(
    optimizer: optax.GradientTransformation,
    loss: Callable[..., Array],
    network: Any,
    memory: Any,
    data: tuple[Array, ...],
    passes: int,
    batches: int,
    key: Array,
) -> tuple[Any, Any, dict[str, Array]]:
    """Return network, optimizer memory and the log of each step, ``(passes * batches,)``, after descent on a loss.

    ``loss(network, *batch)`` is of columns of the ``data``, each ``(N,)`` or ``(n, N)``.
    """

    def step(carry: Any, columns: Array) -> tuple[Any, dict[str, Array]]:
        network, memory = carry
        cost, gradient = jax.value_and_grad(loss)(network, *(part[..., columns] for part in data))
        change, memory = optimizer.update(gradient, memory)
        return (optax.apply_updates(network, change), memory), {"loss": cost, **step_log(gradient, change, network)}

    order = batches_of(key, data[0].shape[-1], passes, batches)
    (network, memory), log = jax.lax.scan(step, (network, memory), order)
    return network, memory, log


def squared_error(network: Any, states: Array, targets: Array) -> Array:
    """Return the mean squared error of a critic's values of normalised ``states (n, N)``."""
    return ((network(states)[0] - targets) ** 2).mean()
