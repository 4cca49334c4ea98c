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
    """

    name = "ppo"

    actor_rate: float = param(1e-3, "first learning rate of the actor", positive=True)
    beta1: float = param(0.9, "decay of Adam's mean gradient", low=0.0, high=0.999999)
    beta2: float = param(0.999, "decay of Adam's mean square", low=0.0, high=0.999999)
    passes: int = param(8, "passes over the states of a window", positive=True)
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
        import optax

        from bench.training import fitting, normaliser, steps, values, windows

        assert state.critic is not None
        critic, key = state.critic, state.key
        key, key_window, key_batches = jax.random.split(key, 3)
        episodes, window = self.window_of(env, state, state.actor, key_window)
        seen = normaliser.normalised(state.normaliser, windows.flat(window.observation))
        action = windows.flat(window.action)
        # the critic is in units of the returns so far, so that its rate suits rewards of any scale
        unit = jnp.sqrt(state.returns.mean**2 + state.returns.variance)
        value = unit * self.values_of(state, critic.network, window)
        before = unit * critic.network(seen).reshape(value.shape)
        advantage = values.advantages(window.reward, before, value, window.ended, self.discount, self.decay)
        targets, advantage = (advantage + before).reshape(1, -1), advantage.reshape(-1)
        returns = normaliser.updated(state.returns, targets)
        targets = targets[0] / unit
        old = state.actor.log_probability(seen, action)
        actor_optimizer, critic_optimizer = self.actor_optimizer(env), self.critic_optimizer(env)

        def value_loss(network: Any, x: Any, y: Any) -> Any:
            return ((network(x)[0] - y) ** 2).mean()

        def step(carry: Any, columns: Any) -> tuple[Any, Any]:
            actor, memory, network, critic_memory = carry
            x, better = seen[:, columns], advantage[columns]
            better = (better - better.mean()) / (better.std() + 1e-8)
            cost, gradient = jax.value_and_grad(self.surrogate)(actor, x, action[:, columns], old[columns], better)
            change, memory = actor_optimizer.update(gradient, memory)
            misfit, slope = jax.value_and_grad(value_loss)(network, x, targets[columns])
            moved, critic_memory = critic_optimizer.update(slope, critic_memory)
            carry = (optax.apply_updates(actor, change), memory, optax.apply_updates(network, moved), critic_memory)
            return carry, (cost, misfit, steps.step_log(gradient, change, actor))

        order = fitting.batches_of(key_batches, targets.shape[0], self.passes, self.batches)
        first = (state.actor, state.memory, critic.network, critic.memory)
        (actor, memory, network, critic_memory), (costs, misfits, logs) = jax.lax.scan(step, first, order)
        log = {
            "loss": costs[0], "value_loss": misfits[-self.batches :].mean() * unit[0] ** 2,
            "deviation": jnp.exp(actor.log_deviation).mean(), **windows.log_of(window),
            **{name: part[0] for name, part in logs.items()},
            "step_length": optax.tree.norm(jax.tree.map(lambda a, b: a - b, actor, state.actor)),
        }  # fmt: skip
        known = normaliser.updated(state.normaliser, windows.flat(window.observation))
        return Run(actor, memory, known, episodes, key, Critic(network, critic.target, critic_memory), returns), log
