"""Targets of a critic from a window of rewards: TD(lambda) returns."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from bench.model.ops import Array


def td_lambda(reward: Array, value: Array, ended: Array, discount: Any, decay: float) -> Array:
    """Return the lambda-returns of a window's states, ``(h, B)``.

    ``G_t = r_t + gamma ((1 - lambda) V_t + lambda G_{t+1})``, where ``V_t`` is the value of the state that step t
    reached, 0 where none follows. After the window's last step, and after a step that ended an episode, the return is
    ``r_t + gamma V_t`` (Sutton, Barto 2018, equation 12.9 in recursive form). Less the values before each step these are generalised
    advantages (Schulman et al. 2016, arXiv 1506.02438, equation 16).
    """

    def back(following: Array, at: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        r, v, end = at
        later = jnp.where(end, v, (1.0 - decay) * v + decay * following)
        return (r + discount * later,) * 2

    _, targets = jax.lax.scan(back, value[-1], (reward, value, ended), reverse=True)
    return targets
