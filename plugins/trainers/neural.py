"""The base of trainers of neural networks: their parameters, their state, and how a run starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from bench.model import Trainer, param


class Critic(NamedTuple):
    """A value network, the target network that follows it, and the memory of its optimizer."""

    network: Any
    target: Any
    memory: Any


class Run(NamedTuple):
    """The state of a run between two updates."""

    actor: Any
    memory: Any
    """Memory of the actor's optimizer."""
    normaliser: Any
    episodes: Any
    key: Any
    critic: Critic = None  # type: ignore[assignment]
    """None for a trainer without values."""
    returns: Any = None
    """Running mean and variance of returns, where the critic's unit is their deviation."""


@dataclass(frozen=True)
class Neural(Trainer):
    """Trains an actor with two hidden layers on normalised observations, by Adam with rates that fall linearly to 1e-5."""

    activation: ClassVar[str] = "normalised_elu"
    """Of the hidden layers of each network."""
    gain: ClassVar[float] = 1.0
    """Of the weights of the actor's last layer at the start."""

    rollouts: int = param(64, "parallel rollouts", positive=True)
    hidden: int = param(64, "width of the two hidden layers of each network", positive=True)
    actor_rate: float = param(1e-2, "first learning rate of the actor", positive=True)
    log_deviation: float = param(-1.0, "initial log standard deviation of the actions")
    clip: float = param(1.0, "norm at which gradients are clipped", positive=True)
    beta1: float = param(0.7, "decay of Adam's mean gradient", low=0.0, high=0.999999)
    beta2: float = param(0.95, "decay of Adam's mean square", low=0.0, high=0.999999)

    def adam(self, rate: float, steps: int) -> Any:
        """Return the optimizer of a network that takes ``steps`` steps in a run."""
        from bench.training.steps import adam

        return adam(rate, steps, self.clip, self.beta1, self.beta2)

    def actor_optimizer(self, env: Any) -> Any:
        """Return the actor's optimizer, which takes one step per update."""
        return self.adam(self.actor_rate, self.updates(env))

    def start(self, env: Any, seed: Any) -> Run:
        import jax

        from bench.training import normaliser
        from bench.training.networks import Actor

        key, key_actor, key_start = jax.random.split(jax.random.PRNGKey(seed), 3)
        layers = [env.n_observations, self.hidden, self.hidden, env.n_actions]
        actor = Actor(key_actor, layers, env.dtype, self.log_deviation, activation=self.activation, gain=self.gain)
        known = normaliser.start(env.n_observations, env.dtype)
        return self.fresh(env, Run(actor, self.actor_optimizer(env).init(actor), known, None, key), key_start)

    def fresh(self, env: Any, state: Run, key: Any) -> Run:
        return state._replace(episodes=env.start(env.normal(key, (env.n_start, self.rollouts))))

    def action(self, env: Any, state: Any, observation: Any) -> Any:
        from bench.training import normaliser

        return state.actor.mean(normaliser.normalised(state.normaliser, observation))

    def rolled(
        self, env: Any, state: Run, actor: Any, first: Any, length: int, key: Any, *cuts: Any
    ) -> tuple[Any, Any]:
        """Return the episodes after ``length`` control steps of an actor, and the window, see ``bench.training.windows``."""
        from bench.training import normaliser, windows

        def policy(observation: Any, noise: Any) -> Any:
            return actor.sample(normaliser.normalised(state.normaliser, observation), noise)

        return windows.rollout(env, policy, first, length, key, *cuts)

    def descended(self, env: Any, state: Run, loss: Any) -> tuple[Any, Any, Any, dict[str, Any]]:
        """Return the actor and its memory after a step on ``loss(actor)``, what else the loss returns, and the step's log."""
        import jax
        import jax.numpy as jnp
        import optax

        from bench.training import steps

        (cost, more), gradient = jax.value_and_grad(loss, has_aux=True)(state.actor)
        change, memory = self.actor_optimizer(env).update(gradient, state.memory)
        actor = optax.apply_updates(state.actor, change)
        log = {
            "loss": cost,
            "deviation": jnp.exp(actor.log_deviation).mean(),
            **steps.step_log(gradient, change, actor),
        }
        return actor, memory, more, log
