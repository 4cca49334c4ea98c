"""SHAC: first-order steps of a policy over short windows that end in a learned value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from bench.model import Trainer, param


class ShacState(NamedTuple):
    """The state of a run between two updates."""

    actor: Any
    critic: Any
    target: Any
    actor_steps: Any
    critic_steps: Any
    normaliser: Any
    episodes: Any
    key: Any


@dataclass(frozen=True)
class Shac(Trainer):
    """Short-horizon actor-critic (Xu et al. 2022, arXiv 2204.07137).

    An update rolls the policy out over ``window`` control steps, with noise on the actions, and takes one step on the
    derivative of the window's return, whose last term is the critic's value (equation 5). The critic is fitted to
    TD(lambda) returns with values of a slowly following target critic. Windows go on where the last update's ended, the
    gradient is cut at the ends of episodes, and the value of an episode at its time limit is that of its last state.
    Rates fall linearly to 1e-5 over the run. With ``cut`` the gradient is also cut after a step with a larger Jacobian
    (AHAC, Georgiev et al. 2024, arXiv 2405.17784), and ``entropy`` rewards a wide distribution of actions.
    """

    name = "shac"
    first_order: ClassVar[bool] = True

    rollouts: int = param(64, "parallel rollouts", positive=True)
    window: int = param(32, "h, control steps of a window", "steps", positive=True)
    hidden: int = param(64, "width of the two hidden layers of actor and critic", positive=True)
    actor_rate: float = param(1e-2, "first learning rate of the actor", positive=True)
    critic_rate: float = param(1e-3, "first learning rate of the critic", positive=True)
    log_deviation: float = param(-1.0, "initial log standard deviation of the actions")
    decay: float = param(0.95, "lambda of the returns that the critic is fitted to", low=0.0, high=1.0)
    passes: int = param(16, "passes of the critic over the window's states", positive=True)
    batches: int = param(4, "batches in a pass", positive=True)
    follow: float = param(0.8, "share by which the target critic approaches the critic per update", positive=True, high=1.0)
    clip: float = param(1.0, "norm at which gradients are clipped", positive=True)
    beta1: float = param(0.7, "decay of Adam's mean gradient", low=0.0, high=0.999999)
    beta2: float = param(0.95, "decay of Adam's mean square", low=0.0, high=0.999999)
    cut: float = param(0.0, "norm of a step's Jacobian above which the gradient is cut; 0: never", low=0.0)
    entropy: float = param(0.0, "weight of the actions' log deviation in the reward of a step", low=0.0)

    def steps_per_update(self, env: Any) -> int:
        """Return rollouts times window."""
        return self.rollouts * self.window

    def _optimizers(self, env: Any) -> tuple[Any, Any]:
        from bench.training.steps import adam

        updates = self.updates(env)
        actor = adam(self.actor_rate, updates, self.clip, self.beta1, self.beta2)
        critic_steps = updates * self.passes * self.batches
        return actor, adam(self.critic_rate, critic_steps, self.clip, self.beta1, self.beta2)

    def start(self, env: Any, seed: Any) -> ShacState:
        """Return new networks and episodes at their starts."""
        import jax

        from bench.training import normaliser
        from bench.training.networks import Actor, Network

        key, *keys = jax.random.split(jax.random.PRNGKey(seed), 4)
        layers = [env.n_observations, self.hidden, self.hidden]
        actor = Actor(keys[0], [*layers, env.n_actions], env.dtype, log_deviation=self.log_deviation)
        critic = Network(keys[1], [*layers, 1], env.dtype)
        actor_steps, critic_steps = self._optimizers(env)
        return ShacState(
            actor, critic, jax.tree.map(lambda x: x + 0.0, critic), actor_steps.init(actor), critic_steps.init(critic),
            normaliser.start(env.n_observations, env.dtype),
            env.start(env.normal(keys[2], (env.scene.n_start, self.rollouts))), key,
        )  # fmt: skip

    def update(self, env: Any, state: ShacState) -> tuple[ShacState, dict[str, Any]]:
        """Return the state after one window, one step of the actor and ``passes`` of the critic."""
        import jax
        import jax.numpy as jnp
        import optax

        from bench.training import normaliser, values, windows
        from bench.training.steps import step_log

        key, key_window, key_critic = jax.random.split(state.key, 3)
        actor_steps, critic_steps = self._optimizers(env)

        def loss(actor: Any) -> tuple[Any, Any]:
            def policy(observation: Any, noise: Any) -> Any:
                return actor.sample(normaliser.normalised(state.normaliser, observation), noise)

            episodes, window = windows.rollout(env, policy, state.episodes, self.window, key_window, self.cut)
            reached = normaliser.normalised(state.normaliser, jnp.moveaxis(window.reached, 1, 0))
            value = state.target(reached.reshape(env.n_observations, -1)).reshape(window.reward.shape)
            value = jnp.where(window.terminated, 0.0, value)
            cost = windows.objective(window, value, env.discount)
            return cost - self.entropy * actor.log_deviation.sum(), (episodes, window, value)

        (cost, (episodes, window, value)), gradient = jax.value_and_grad(loss, has_aux=True)(state.actor)
        change, actor_memory = actor_steps.update(gradient, state.actor_steps)
        actor = optax.apply_updates(state.actor, change)

        targets = values.td_lambda(window.reward, value, window.ended, env.discount, self.decay)
        states = normaliser.normalised(state.normaliser, jnp.moveaxis(window.observation, 1, 0))
        critic, critic_memory, value_loss = fit(
            critic_steps, state.critic, state.critic_steps, states.reshape(env.n_observations, -1), targets.reshape(-1),
            self.passes, self.batches, key_critic,
        )  # fmt: skip
        target = optax.incremental_update(critic, state.target, self.follow)
        observed = jnp.moveaxis(window.observation, 1, 0).reshape(env.n_observations, -1)
        log = {
            "loss": cost, "value_loss": value_loss, "deviation": jnp.exp(actor.log_deviation).mean(),
            **windows.log_of(window), **step_log(gradient, change, actor),
        }  # fmt: skip
        known = normaliser.updated(state.normaliser, observed)
        return ShacState(actor, critic, target, actor_memory, critic_memory, known, episodes, key), log

    def action(self, env: Any, state: ShacState, observation: Any) -> Any:
        """Return the mean of the policy's distribution."""
        from bench.training import normaliser

        return state.actor.mean(normaliser.normalised(state.normaliser, observation))


def fit(
    optimizer: Any, critic: Any, memory: Any, states: Any, targets: Any, passes: int, batches: int, key: Any
) -> tuple[Any, Any, Any]:
    """Return critic, optimizer state and mean loss of the last pass, fitted to ``targets (N,)`` at ``states (n, N)``."""
    import jax
    import jax.numpy as jnp
    import optax

    count = targets.shape[0] // batches

    def loss(critic: Any, x: Any, y: Any) -> Any:
        return ((critic(x)[0] - y) ** 2).mean()

    def batch(carry: Any, rows: Any) -> tuple[Any, Any]:
        critic, memory = carry
        cost, gradient = jax.value_and_grad(loss)(critic, states[:, rows], targets[rows])
        change, memory = optimizer.update(gradient, memory)
        return (optax.apply_updates(critic, change), memory), cost

    orders = jax.vmap(lambda k: jax.random.permutation(k, targets.shape[0])[: batches * count])(jax.random.split(key, passes))
    (critic, memory), costs = jax.lax.scan(batch, (critic, memory), orders.reshape(passes * batches, count))
    return critic, memory, jnp.mean(costs[-batches:])
