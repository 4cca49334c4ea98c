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

        from bench.training import normaliser, windows

        key, key_window = jax.random.split(state.key)

        def loss(actor: Any) -> tuple[Any, Any]:
            gained, window = self._episodes(env, state, actor, key_window)
            return -gained.mean(), window

        actor, memory, window, log = self.descended(env, state, loss)
        known = normaliser.updated(state.normaliser, windows.flat(window.observation))
        return Run(actor, memory, known, state.episodes, key), log | windows.log_of(window)

    def parts(self, env: Any, state: Run, actor: Any, key: Any) -> tuple[Any, Any, Any]:
        from bench.training import windows

        gained, window = self._episodes(env, state, actor, key)
        return gained, window.cut, windows.log_probability(actor, state.normaliser, window)

    def _episodes(self, env: Any, state: Run, actor: Any, key: Any) -> tuple[Any, Any]:
        """Return the gains of new episodes, and their window."""
        import jax
        import jax.numpy as jnp

        from bench.training import windows

        key_start, key_noise = jax.random.split(key)
        first = self.fresh(env, state, key_start).episodes
        _, window = self.rolled(env, state, actor, first, env.length, key_noise)
        return windows.gains(window, jnp.zeros_like(window.reward), self.discount), window
