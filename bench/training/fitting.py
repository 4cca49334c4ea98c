"""Fits a value network to targets by passes over shuffled batches."""

from __future__ import annotations

from typing import Any

import jax
import optax

from bench.errors import UserError
from bench.model.ops import Array


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
    optimizer: optax.GradientTransformation, network: Any, memory: Any, states: Array, targets: Array, passes: int,
    batches: int, key: Array,
) -> tuple[Any, Any, Array]:  # fmt: skip
    """Return network, optimizer memory and mean loss of the last pass, fitted to ``targets (N,)`` at ``states (n, N)``."""

    def loss(network: Any, x: Array, y: Array) -> Array:
        return ((network(x)[0] - y) ** 2).mean()

    def step(carry: Any, columns: Array) -> tuple[Any, Array]:
        network, memory = carry
        cost, gradient = jax.value_and_grad(loss)(network, states[:, columns], targets[columns])
        change, memory = optimizer.update(gradient, memory)
        return (optax.apply_updates(network, change), memory), cost

    order = batches_of(key, targets.shape[0], passes, batches)
    (network, memory), costs = jax.lax.scan(step, (network, memory), order)
    return network, memory, costs[-batches:].mean()
