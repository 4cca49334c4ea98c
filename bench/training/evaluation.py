"""Returns of a deterministic policy over whole episodes from given starts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from bench.model.ops import Array
from bench.training.environment import Environment, Episodes


def returns(env: Environment, policy: Callable[[Array], Array], numbers: Array) -> Array:
    """Return the undiscounted returns ``(B,)`` of episodes from starts ``numbers (n_start, B)`` to their first end.

    ``policy`` gives actions ``(n_u, B)`` from observations ``(n_observations, B)``.
    """

    def step(carry: tuple[Episodes, Array, Array], _: Any) -> tuple[tuple[Episodes, Array, Array], None]:
        episodes, total, over = carry
        moved = env.step(episodes, policy(env.observe(episodes.state)), numbers)
        total = total + jnp.where(over, 0.0, moved.reward)
        return (moved.next, total, over | moved.ended), None

    first = env.start(numbers)
    carry = (first, jnp.zeros(numbers.shape[1], numbers.dtype), jnp.zeros(numbers.shape[1], dtype=bool))
    (_, total, _), _ = jax.lax.scan(step, carry, None, length=env.length)
    return total
