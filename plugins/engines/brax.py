"""Brax's generalized pipeline, differentiated forward by JAX, all columns together."""

import jax
import numpy as np
from brax.generalized import pipeline
from brax.io import mjcf
from mujoco_twin import mujoco_model

jax.config.update("jax_enable_x64", True)


class Model:
    """A twin as a Brax system, compiled for each width."""

    takes_forces = True
    widths = (64, 512)

    def __init__(self, program):
        self.device = jax.default_backend()
        n, system = len(program["bodies"]), mjcf.load_model(mujoco_model(program))
        system = system.replace(solver_maxls=program["backend"]["halvings"])
        if program["contacts"]:
            _check_contacts(system)

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


def _check_contacts(system):
    from mujoco import mjx

    if mjx.make_data(system).ncon == 0:
        raise NotImplementedError("Brax finds no contacts in the twin")
