"""Plain backpropagation through whole episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bench.model import param

from .neural import Neural, Run


@dataclass(frozen=True)
class Bptt(Neural):
    """Backpropagation through time: each update takes one step on the derivative of whole episodes' mean return.

    Every update starts ``rollouts`` new episodes, with noise on the actions. It has neither critic nor discount, and no
    cut except at the ends of episodes. The loss is the mean cost of a control step.
    """

    name = "bptt"
    first_order = True

    discount: float = param(1.0, "gamma, factor on the reward of the next control step", positive=True, high=1.0)

    def steps_per_update(self, env: Any) -> int:
        return self.rollouts * int(env.length)

    def update(self, env: Any, state: Run) -> tuple[Run, dict[str, Any]]:
        import jax
        import jax.numpy as jnp
        import optax

        from bench.training import normaliser, steps, windows

        key, key_window = jax.random.split(state.key)

        def loss(actor: Any) -> tuple[Any, Any]:
            window = self._window(env, state, actor, key_window)
            return -self._gains(window).mean(), window

        (cost, window), gradient = jax.value_and_grad(loss, has_aux=True)(state.actor)
        change, memory = self.actor_optimizer(env).update(gradient, state.memory)
        actor = optax.apply_updates(state.actor, change)
        log = {
            "loss": cost, "deviation": jnp.exp(actor.log_deviation).mean(),
            **windows.log_of(window), **steps.step_log(gradient, change, actor),
        }  # fmt: skip
        known = normaliser.updated(state.normaliser, windows.flat(window.observation))
        return Run(actor, memory, known, state.episodes, key), log

    def parts(self, env: Any, state: Run, actor: Any, key: Any) -> tuple[Any, Any, Any]:
        from bench.training import windows

        window = self._window(env, state, actor, key)
        return self._gains(window), window.cut, windows.log_probability(actor, state.normaliser, window)

    def _gains(self, window: Any) -> Any:
        import jax.numpy as jnp

        from bench.training import windows

        return windows.gains(window, jnp.zeros_like(window.reward), self.discount)

    def _window(self, env: Any, state: Run, actor: Any, key: Any) -> Any:
        import jax

        from bench.training import normaliser, windows

        key_start, key_noise = jax.random.split(key)

        def policy(observation: Any, noise: Any) -> Any:
            return actor.sample(normaliser.normalised(state.normaliser, observation), noise)

        first = env.start(env.normal(key_start, (env.scene.n_start, self.rollouts)))
        return windows.rollout(env, policy, first, env.length, key_noise)[1]
