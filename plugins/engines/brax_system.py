"""A system of Brax's generalized pipeline, with the derivatives of a step, all columns together."""

import jax
import numpy as np
from brax.generalized import pipeline

jax.config.update("jax_enable_x64", True)


class System:
    """A Brax system, compiled for each width."""

    def __init__(self, system):
        n = system.q_size()

        def step(x, u):
            state = pipeline.init(system, x[:n], x[n:])
            state = pipeline.step(system, state, u)
            return jax.numpy.concatenate([state.q, state.qd])

        self._step = jax.jit(jax.vmap(step, -1, -1))
        self._jacobians = jax.jit(jax.vmap(jax.jacfwd(step, (0, 1)), -1, -1))

    def step(self, x, u):
        """Return the states after one step."""
        return np.asarray(self._step(x, u))

    def jacobians(self, x, u):
        """Return the derivatives of one step."""
        return [np.asarray(part) for part in self._jacobians(x, u)]
