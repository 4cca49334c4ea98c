"""Evolution strategies: searches over a policy's parameters that use returns only."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

from bench.model import Trainer, param


class Search(NamedTuple):
    """The state of a search between two updates."""

    theta: Any
    """Parameters of the policy's network, flattened, ``(d,)``."""
    memory: Any
    normaliser: Any
    key: Any


@dataclass(frozen=True)
class PopulationTrainer(Trainer):
    """Runs one episode each of ``population`` policies per update. A state has ``theta`` and ``normaliser``.

    Rollouts last as long as an episode can. Steps after an episode's first end count as control steps, but are not used.
    """

    population: int = param(64, "policies per update, an even number", low=2)
    width: float = param(0.05, "standard deviation of the parameters", positive=True)
    hidden: int = param(64, "width of the two hidden layers", positive=True)

    def steps_per_update(self, env: Any) -> int:
        return 2 * (self.population // 2) * int(env.length)

    def network(self, env: Any, key: Any) -> tuple[Any, Any]:
        """Return a new network's parameters, flattened, ``(d,)``, and the function from these to the network."""
        from jax.flatten_util import ravel_pytree

        from bench.training.networks import Network

        return ravel_pytree(Network(key, [env.n_observations, self.hidden, self.hidden, env.n_actions], env.dtype))

    def start(self, env: Any, seed: Any) -> Any:
        import jax

        from bench.training import normaliser

        key, key_network = jax.random.split(jax.random.PRNGKey(seed))
        theta, _ = self.network(env, key_network)
        return self.search(env, theta, normaliser.start(env.n_observations, env.dtype), key)

    @abstractmethod
    def search(self, env: Any, theta: Any, known: Any, key: Any) -> Any:
        """Return the state before the first update, from the parameters ``theta (d,)`` and a normaliser."""

    def returns(self, env: Any, state: Any, points: Any, first: Any, keys: tuple[Any, Any]) -> tuple[Any, ...]:
        """Return the returns ``(B,)`` of policies with parameters ``points (B, d)`` from given starts, normaliser and log."""
        import jax
        import jax.numpy as jnp

        from bench.training import normaliser, windows

        _, unflatten = self.network(env, keys[0])
        networks = jax.vmap(unflatten)(points)

        def policy(observation: Any, noise: Any) -> Any:
            seen = normaliser.normalised(state.normaliser, observation).T[:, :, None]
            return jax.vmap(lambda network, x: network(x))(networks, seen)[:, :, 0].T

        _, window = windows.rollout(env, policy, first, env.length, keys[1])
        # an episode counts up to its first end
        is_running = jnp.cumsum(window.ended, axis=0) - window.ended == 0
        total = jnp.where(is_running, window.reward, 0.0).sum(axis=0)
        log = {"used": is_running.mean(dtype=window.reward.dtype), "loss": -total.mean() / env.length}
        known = normaliser.updated(state.normaliser, windows.flat(window.observation))
        return total, known, windows.log_of(window) | log

    def action(self, env: Any, state: Any, observation: Any) -> Any:
        import jax

        from bench.training import normaliser

        _, unflatten = self.network(env, jax.random.PRNGKey(0))
        return unflatten(state.theta)(normaliser.normalised(state.normaliser, observation))


@dataclass(frozen=True)
class Evolution(PopulationTrainer):
    """Evolution strategies (Salimans et al. 2017, arXiv 1703.03864) on the flattened parameters of a network.

    An update runs one episode each of ``population`` policies, theta plus and minus ``width`` times normal numbers,
    from the same start for both signs. Returns are replaced by their ranks, from -1/2 to 1/2, and Adam ascends the mean
    of rank times direction.
    """

    name = "evolution"

    rate: float = param(0.02, "first learning rate", positive=True)
    clip: float = param(1e6, "norm at which gradients are clipped", positive=True)

    def _optimizer(self, env: Any) -> Any:
        from bench.training.steps import adam

        return adam(self.rate, self.updates(env), self.clip, 0.9, 0.999)

    def search(self, env: Any, theta: Any, known: Any, key: Any) -> Search:
        return Search(theta, self._optimizer(env).init(theta), known, key)

    def update(self, env: Any, state: Search) -> tuple[Search, dict[str, Any]]:
        import jax
        import jax.numpy as jnp
        import optax

        from bench.training.steps import step_log

        key, key_points, key_start, key_rollout = jax.random.split(state.key, 4)
        half = self.population // 2
        direction = env.normal(key_points, (half, state.theta.size))
        points = state.theta + self.width * jnp.concatenate([direction, -direction])
        numbers = env.normal(key_start, (env.n_start, half))
        first = env.start(jnp.concatenate([numbers, numbers], axis=1))
        total, known, log = self.returns(env, state, points, first, (key, key_rollout))
        rank = jnp.argsort(jnp.argsort(jnp.where(jnp.isfinite(total), total, -jnp.inf))) / (2 * half - 1) - 0.5
        rank = rank.astype(state.theta.dtype)
        gradient = -(rank[:half] - rank[half:]) @ direction / (2 * half * self.width)
        change, memory = self._optimizer(env).update(gradient, state.memory)
        theta = optax.apply_updates(state.theta, change)
        return Search(theta, memory, known, key), log | step_log(gradient, change, theta)
