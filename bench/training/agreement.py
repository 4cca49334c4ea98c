"""Compares the first-order gradient of a window's objective with a zeroth-order one of the same objective."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from bench.model.ops import Array
from bench.training.windows import gains_to_go

Parts = Callable[[Any, Array], tuple[Array, Array, Array]]
"""Gains ``(h, B)``, cuts ``(h, B)`` and log probabilities of the actions ``(h, B)``, from an actor and a key.

Log probabilities are of the given actor for actions that count as constants.
"""


def cosine(parts: Parts, actor: Any, key: Array, copies: int) -> dict[str, Array]:
    """Return the cosine between both gradients, and its value if both had no noise, from ``copies`` of each rollout.

    The first half of the copies gives one pair of gradients, the second half another. ``cosine`` is that of the means.
    ``cosine_denoised`` divides products between halves by products between halves (Spearman 1904): noise cancels, and
    where a denominator is not positive, the noise is larger than the gradient and the value is NaN. Copies share starts
    but no noise.
    """

    def both(key: Array) -> tuple[Array, Array]:
        keys = jax.random.split(key, copies // 2)

        def shares(actor: Any) -> tuple[tuple[Array, Array], Array]:
            gained, cut, log_probability = jax.vmap(lambda k: parts(actor, k))(keys)
            return (gained, log_probability), cut

        (gained, _), back, cut = jax.vjp(shares, actor, has_aux=True)
        to_go = jax.vmap(gains_to_go)(gained, cut)
        # the mean over copies is a baseline; the factor makes up for each copy's share in its own
        better = (to_go - to_go.mean(axis=0)) * (copies / 2 / max(copies // 2 - 1, 1))
        nothing = jnp.zeros_like(gained)
        (first,) = back((nothing - 1.0 / gained.size, nothing))
        (zeroth,) = back((nothing, -better / gained.size))
        return ravel_pytree(first)[0], ravel_pytree(zeroth)[0]

    (first, other_first), (zeroth, other_zeroth) = jax.lax.map(both, jax.random.split(key))
    mean_first, mean_zeroth = first + other_first, zeroth + other_zeroth
    across = (first @ other_zeroth + other_first @ zeroth) / 2
    scale = (first @ other_first) * (zeroth @ other_zeroth)
    norms = jnp.linalg.norm(mean_first) * jnp.linalg.norm(mean_zeroth)
    return {
        "cosine": mean_first @ mean_zeroth / norms,
        "cosine_denoised": jnp.where(scale > 0, across / jnp.sqrt(jnp.where(scale > 0, scale, 1.0)), jnp.nan),
    }
