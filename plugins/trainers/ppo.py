"""PPO with states and a value function: the zeroth-order counterpart of SHAC."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bench.model import param

from .actor_critic import ActorCritic
from .neural import Critic, Run


@dataclass(frozen=True)
class Ppo(ActorCritic):
    """Proximal policy optimisation (Schulman et al. 2017, arXiv 1707.06347, equation 7).

    An update rolls the policy out over ``window`` control steps and takes ``passes`` times ``batches`` steps on
    min(r A, clip(r, 1 - range, 1 + range) A), with the ratio r of the probabilities of an action under the new and the
    old policy, and generalised advantages A (lambda = ``decay``) of the critic, in standard deviations per batch. The
    critic takes as many steps towards the lambda-returns. Only rewards of the simulation are used, not its derivative.
    Defaults are those of Stable-Baselines3 (Raffin et al. 2021), with 8 rollouts and a rate that falls.
    """

    name = "ppo"
    revision = 2
    activation = "tanh"
    gain = 0.01

    rollouts: int = 8
    window: int = 256
    actor_rate: float = 3e-4
    critic_rate: float = 3e-4
    log_deviation: float = 0.0
    clip: float = 0.5
    beta1: float = 0.9
    beta2: float = 0.999
    passes: int = 10
    batches: int = 32
    range: float = param(0.2, "distance of a ratio from 1 at which the objective is clipped", positive=True)
    entropy: float = param(0.0, "weight of the actions' log deviation in the objective", low=0.0)

    def start(self, env: Any, seed: Any) -> Run:
        from bench.training import normaliser

        return super().start(env, seed)._replace(returns=normaliser.start(1, env.dtype))

    def actor_optimizer(self, env: Any) -> Any:
        return self.adam(self.actor_rate, self.updates(env) * self.passes * self.batches)

    def surrogate(self, actor: Any, seen: Any, action: Any, old: Any, advantage: Any) -> Any:
        """Return minus the mean clipped objective of normalised observations and actions, each ``(n, N)``.

        ``old (N,)`` are the log probabilities under the policy that drew the actions.
        """
        import jax.numpy as jnp

        ratio = jnp.exp(actor.log_probability(seen, action) - old)
        clipped = jnp.clip(ratio, 1.0 - self.range, 1.0 + self.range)
        return -jnp.minimum(ratio * advantage, clipped * advantage).mean() - self.entropy * actor.log_deviation.sum()

    def update(self, env: Any, state: Run) -> tuple[Run, dict[str, Any]]:
        import jax
        import jax.numpy as jnp

        from bench.training import normaliser, steps, windows

        critic = state.critic
        key, key_window, key_actor, key_critic = jax.random.split(state.key, 4)
        episodes, window = self.rolled(env, state, state.actor, state.episodes, self.window, key_window)
        observation, action = windows.flat(window.observation), windows.flat(window.action)
        seen = normaliser.normalised(state.normaliser, observation)
        # rewards are in standard deviations of the returns so far, without the critic's values, whose errors would grow
        alone = windows.td_lambda(window.reward, jnp.zeros_like(window.reward), window.ended, self.discount, 1.0)
        returns = normaliser.updated(state.returns, alone.reshape(1, -1))
        unit = normaliser.deviation(returns)[0]
        value, before = self.values_of(state, critic.network, window), critic.network(seen).reshape(window.reward.shape)
        advantage = windows.td_lambda(window.reward / unit, value, window.ended, self.discount, self.decay) - before
        old = state.actor.log_probability(seen, action)

        def loss(actor: Any, *batch: Any) -> Any:
            seen, action, old, better = batch
            return self.surrogate(actor, seen, action, old, (better - better.mean()) / (better.std() + 1e-8))

        actor, memory, log = steps.fit(
            self.actor_optimizer(env),
            loss,
            state.actor,
            state.memory,
            (seen, action, old, advantage.reshape(-1)),
            self.passes,
            self.batches,
            key_actor,
        )
        network, critic_memory, fitted = steps.fit(
            self.critic_optimizer(env),
            steps.squared_error,
            critic.network,
            critic.memory,
            (seen, (advantage + before).reshape(-1)),
            self.passes,
            self.batches,
            key_critic,
        )
        log = {name: entries[0] for name, entries in log.items()} | {
            "value_loss": fitted["loss"][-self.batches :].mean() * unit**2,
            "deviation": jnp.exp(actor.log_deviation).mean(),
            **windows.log_of(window),
        }
        known = normaliser.updated(state.normaliser, observation)
        return Run(actor, memory, known, episodes, key, Critic(network, critic.target, critic_memory), returns), log
