"""Multilayer perceptrons for policies and values, on batch-last arrays, by Equinox."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from bench.model.ops import Array


def normalised_elu(x: Array) -> Array:
    """Return ELU's outputs normalised over the units (Ba et al. 2016, arXiv 1607.06450, without gain and bias).

    Without it, one seed in five of SHAC ends lower on the cart-pole.
    """
    x = jax.nn.elu(x)
    # the addition to the variance keeps a layer of equal outputs from a division by 0
    return (x - x.mean(axis=0)) / jnp.sqrt(x.var(axis=0) + 1e-5)


ACTIVATIONS = {"normalised_elu": normalised_elu, "tanh": jnp.tanh}
"""Functions of a hidden layer's outputs, by name."""


class Network(eqx.Module):
    """A perceptron ``(n_in, B) -> (n_out, B)``: weights ``(n_out, n_in)`` and biases ``(n_out, 1)`` by layer."""

    weights: list[Array]
    biases: list[Array]
    activation: str = eqx.field(static=True)

    def __init__(
        self, key: Array, sizes: Sequence[int], dtype: Any, activation: str = "normalised_elu", gain: float = 1.0
    ) -> None:
        """Draw orthogonal weights with gain sqrt(2), ``gain`` in the last layer; biases are 0."""
        keys = jax.random.split(key, len(sizes) - 1)
        gains = [2.0**0.5] * (len(sizes) - 2) + [gain]
        self.weights = [
            jax.nn.initializers.orthogonal(gain)(k, (n_out, n_in), dtype)
            for k, gain, n_in, n_out in zip(keys, gains, sizes[:-1], sizes[1:], strict=True)
        ]
        self.biases = [jnp.zeros((n, 1), dtype) for n in sizes[1:]]
        self.activation = activation

    def __call__(self, x: Array) -> Array:
        """Return the outputs ``(n_out, B)`` of ``x (n_in, B)``."""
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = ACTIVATIONS[self.activation](weight @ x + bias)
        return self.weights[-1] @ x + self.biases[-1]


class Actor(eqx.Module):
    """A normal distribution of actions: the mean is a network of the observation, the log deviation is learned."""

    mean: Network
    log_deviation: Array
    """``(n_u, 1)``, the same for all observations."""

    def __init__(
        self, key: Array, sizes: Sequence[int], dtype: Any, log_deviation: float = -1.0, **network: Any
    ) -> None:
        self.mean = Network(key, sizes, dtype, **network)
        self.log_deviation = jnp.full((sizes[-1], 1), log_deviation, dtype)

    def sample(self, observation: Array, noise: Array) -> Array:
        """Return actions ``(n_u, B)`` from standard normal ``noise (n_u, B)``."""
        return self.mean(observation) + jnp.exp(self.log_deviation) * noise

    def log_probability(self, observation: Array, action: Array) -> Array:
        """Return the log density of ``action (n_u, B)``, ``(B,)``."""
        z = (action - self.mean(observation)) / jnp.exp(self.log_deviation)
        return -(0.5 * z**2 + self.log_deviation + 0.5 * jnp.log(2 * jnp.pi)).sum(axis=0)
