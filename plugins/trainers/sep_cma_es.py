"""CMA-ES with a diagonal covariance, over all parameters of a policy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from ..optimizers.cma_es import constants
from .evolution import PopulationTrainer


class Search(NamedTuple):
    """The state of a search between two updates."""

    theta: Any
    """Mean of the parameters, ``(d,)``."""
    sigma: Any
    """Step size."""
    variance: Any
    """Diagonal of the covariance, in units of sigma^2, ``(d,)``."""
    path_sigma: Any
    path_c: Any
    count: Any
    """Updates so far."""
    normaliser: Any
    key: Any


@dataclass(frozen=True)
class SepCmaEs(PopulationTrainer):
    """CMA-ES with a diagonal covariance (Ros, Hansen 2008, https://doi.org/10.1007/978-3-540-87700-4_30).

    An update draws ``population`` policies from a normal distribution of all parameters, runs one episode of each from
    the same start, and moves mean, step size and variances to the better half. The constants are the same as in
    the optimizer ``cma_es``, with both learning rates of the covariance times (d + 2) / 3. A full covariance would
    have d^2 entries, 2e7 by default. A policy without a finite return is ranked last.
    """

    name = "sep_cma_es"

    def search(self, env: Any, theta: Any, known: Any, key: Any) -> Search:
        import jax.numpy as jnp

        zero = jnp.zeros_like(theta)
        sigma = jnp.asarray(self.width, theta.dtype)
        return Search(theta, sigma, jnp.ones_like(theta), zero, zero, jnp.zeros((), jnp.int32), known, key)

    def update(self, env: Any, state: Search) -> tuple[Search, dict[str, Any]]:
        import jax
        import jax.numpy as jnp

        from bench.training.steps import step_log

        key, key_points, key_start, key_rollout = jax.random.split(state.key, 4)
        size, d = 2 * (self.population // 2), state.theta.size
        y = jnp.sqrt(state.variance) * env.normal(key_points, (size, d))
        numbers = jnp.broadcast_to(env.normal(key_start, (env.n_start, 1)), (env.n_start, size))
        points = state.theta + state.sigma * y
        total, known, log = self.returns(env, state, points, env.start(numbers), (key, key_rollout))

        k = constants(d, size)
        c_1 = min(1.0, k.c_1 * (d + 2) / 3)
        c_mu = min(1.0 - c_1, k.c_mu * (d + 2) / 3)
        best = y[jnp.argsort(-jnp.where(jnp.isfinite(total), total, -jnp.inf))[: k.weights.size]]
        weights = jnp.asarray(k.weights, y.dtype)
        step = weights @ best
        white = math.sqrt(k.c_sigma * (2 - k.c_sigma) * k.mu_eff) * step / jnp.sqrt(state.variance)
        path_sigma = (1 - k.c_sigma) * state.path_sigma + white
        norm = jnp.linalg.norm(path_sigma)
        started = jnp.sqrt(1 - (1 - k.c_sigma) ** (2.0 * (state.count + 1)))
        is_settled = norm / started < (1.4 + 2 / (d + 1)) * k.chi
        path_c = (1 - k.c_c) * state.path_c + is_settled * math.sqrt(k.c_c * (2 - k.c_c) * k.mu_eff) * step
        lost = (1 - is_settled) * c_1 * k.c_c * (2 - k.c_c)
        variance = (1 - c_1 - c_mu + lost) * state.variance + c_1 * path_c**2 + c_mu * (weights @ best**2)
        sigma = state.sigma * jnp.exp(jnp.minimum(1.0, k.c_sigma / k.d_sigma * (norm / k.chi - 1)))

        change = state.sigma * step
        theta = state.theta + change
        log |= {"deviation": state.sigma * jnp.sqrt(state.variance.mean()), **step_log(-step, change, theta)}
        kind = state.theta.dtype
        return Search(
            theta.astype(kind),
            sigma.astype(kind),
            variance.astype(kind),
            path_sigma.astype(kind),
            path_c.astype(kind),
            state.count + 1,
            known,
            key,
        ), log
