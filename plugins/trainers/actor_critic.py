"""The base of trainers with a learned value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bench.model import param

from .neural import Critic, Neural, Run


@dataclass(frozen=True)
class ActorCritic(Neural):
    """Trains an actor on windows of control steps that end in a critic's value; windows go on between updates."""

    window: int = param(32, "h, control steps of a window", "steps", positive=True)
    discount: float = param(0.99, "gamma, factor on the value of the next control step", positive=True, high=1.0)
    critic_rate: float = param(1e-3, "first learning rate of the critic", positive=True)
    decay: float = param(0.95, "lambda of returns and advantages", low=0.0, high=1.0)
    passes: int = param(16, "passes over the states of a window", positive=True)
    batches: int = param(4, "batches in a pass", positive=True)

    def steps_per_update(self, env: Any) -> int:
        return self.rollouts * self.window

    def critic_optimizer(self, env: Any) -> Any:
        """Return the critic's optimizer, which takes a step per pass and batch."""
        return self.adam(self.critic_rate, self.updates(env) * self.passes * self.batches)

    def start(self, env: Any, seed: Any) -> Run:
        import jax

        from bench.training.networks import Network

        run = super().start(env, seed)
        key, key_critic = jax.random.split(run.key)
        network = Network(key_critic, [env.n_observations, self.hidden, self.hidden, 1], env.dtype, self.activation)
        memory = self.critic_optimizer(env).init(network)
        return run._replace(key=key, critic=Critic(network, jax.tree.map(lambda x: 1.0 * x, network), memory))

    def values_of(self, state: Run, network: Any, window: Any) -> Any:
        """Return a network's values of the states that a window's steps reached, 0 where none follows, ``(h, B)``."""
        import jax.numpy as jnp

        from bench.training import normaliser, windows

        reached = normaliser.normalised(state.normaliser, windows.flat(window.reached))
        return jnp.where(window.terminated, 0.0, network(reached).reshape(window.reward.shape))
