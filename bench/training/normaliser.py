"""Normalises observations by their running mean and variance."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from bench.model.ops import Array


class Normaliser(NamedTuple):
    """Count, mean ``(n,)`` and variance ``(n,)`` of all observations so far."""

    count: Array
    mean: Array
    variance: Array


def start(n: int, dtype: Any) -> Normaliser:
    """Return the normaliser before the first observation."""
    # weight of the initial mean 0 and variance 1, so small that the first observations replace them
    return Normaliser(jnp.asarray(1e-4, dtype), jnp.zeros(n, dtype), jnp.ones(n, dtype))


def updated(known: Normaliser, observations: Array) -> Normaliser:
    """Return the normaliser after further ``observations (n, B)`` (Chan, Golub, LeVeque 1979, equations 2.1)."""
    count = observations.shape[1]
    mean, variance = observations.mean(axis=1), observations.var(axis=1)
    total = known.count + count
    change = mean - known.mean
    squares = known.variance * known.count + variance * count + change**2 * known.count * count / total
    return Normaliser(total, known.mean + change * count / total, squares / total)


def deviation(known: Normaliser) -> Array:
    """Return the standard deviations, ``(n,)``."""
    # the addition to the variance keeps a constant observation from a division by 0
    return jnp.sqrt(known.variance + 1e-5)


def normalised(known: Normaliser, observations: Array) -> Array:
    """Return ``observations (n, ...)`` minus their mean, over their standard deviation."""
    column = (-1, *(1,) * (observations.ndim - 1))
    return (observations - known.mean.reshape(column)) / deviation(known).reshape(column)
