"""Steps of networks by optax: learning rates that fall linearly, clipping by norm, and the log of a step."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax

from bench.model.ops import Array

LAST_RATE = 1e-5
"""Learning rate at the end of a run (Xu et al. 2022, public configuration)."""


def adam(
    rate: float, updates: int, clip: float, beta1: float = 0.7, beta2: float = 0.95
) -> optax.GradientTransformation:
    """Return Adam with a norm clipped at ``clip``, and a rate that falls linearly to 1e-5 over ``updates`` steps."""
    schedule = optax.linear_schedule(rate, min(LAST_RATE, rate), updates)
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
