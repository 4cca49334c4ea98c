"""Fits networks to data by passes over shuffled batches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import optax

from bench.errors import UserError
from bench.model.ops import Array
from bench.training.steps import step_log


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
    optimizer: optax.GradientTransformation, loss: Callable[..., Array], network: Any, memory: Any, data: tuple[Array, ...],
    passes: int, batches: int, key: Array,
) -> tuple[Any, Any, dict[str, Array]]:  # fmt: skip
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
