"""SHAC: first-order steps of a policy over short windows that end in a learned value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bench.model import param

from .actor_critic import ActorCritic
from .neural import Critic, Run


@dataclass(frozen=True)
class Shac(ActorCritic):
    """Short-horizon actor-critic (Xu et al. 2022, arXiv 2204.07137).

    An update rolls the policy out over ``window`` control steps, with noise on the actions, and takes one step on the
    derivative of the window's return, whose last term is the critic's value (equation 5). The critic is fitted to
    TD(lambda) returns with values of a target critic that follows it slowly. Windows go on where the last
    update's windows ended, the gradient is cut at the ends of episodes, and the value of an episode at its time limit is that of
    its last state. With ``cut`` the gradient is also cut after a step with a larger Jacobian (AHAC, Georgiev et al.
    2024, arXiv 2405.17784), and ``entropy`` rewards a wide distribution of actions.
    """

    name = "shac"
    first_order = True

    follow: float = param(
        0.8, "share by which the target critic approaches the critic per update", positive=True, high=1.0
    )
    cut: float = param(0.0, "norm of a step's Jacobian above which the gradient is cut; 0: never", low=0.0)
    entropy: float = param(0.0, "weight of the actions' log deviation in the objective", low=0.0)

    def update(self, env: Any, state: Run) -> tuple[Run, dict[str, Any]]:
        import jax
        import optax

        from bench.training import normaliser, steps, windows

        critic = state.critic
        key, key_window, key_critic = jax.random.split(state.key, 3)

        def loss(actor: Any) -> tuple[Any, Any]:
            episodes, window = self.rolled(env, state, actor, state.episodes, self.window, key_window, self.cut)
            value = self.values_of(state, critic.target, window)
            cost = -windows.gains(window, value, self.discount).mean()
            return cost - self.entropy * actor.log_deviation.sum(), (episodes, window, value)

        actor, memory, (episodes, window, value), log = self.descended(env, state, loss)
        targets = windows.td_lambda(window.reward, value, window.ended, self.discount, self.decay)
        seen = windows.flat(window.observation)
        network, critic_memory, fitted = steps.fit(
            self.critic_optimizer(env),
            steps.squared_error,
            critic.network,
            critic.memory,
            (normaliser.normalised(state.normaliser, seen), targets.reshape(-1)),
            self.passes,
            self.batches,
            key_critic,
        )
        target = optax.incremental_update(network, critic.target, self.follow)
        log |= {"value_loss": fitted["loss"][-self.batches :].mean(), **windows.log_of(window)}
        known = normaliser.updated(state.normaliser, seen)
        return Run(actor, memory, known, episodes, key, Critic(network, target, critic_memory)), log

    def parts(self, env: Any, state: Run, actor: Any, key: Any, every: int = 0) -> tuple[Any, Any, Any]:
        from bench.training import windows

        _, window = self.rolled(env, state, actor, state.episodes, self.window, key, self.cut, every)
        value = self.values_of(state, state.critic.target, window)
        gained = windows.gains(window, value, self.discount, every)
        return gained, window.cut, windows.log_probability(actor, state.normaliser, window)
