"""Brax's generalized pipeline, differentiated forward by JAX, all columns together."""

import jax
from brax.io import mjcf
from brax_system import System
from mujoco_twin import mujoco_model


class Model(System):
    """A twin as a Brax system."""

    takes_forces = True
    widths = (64, 512)

    def __init__(self, program):
        self.device = jax.default_backend()
        system = mjcf.load_model(mujoco_model(program))
        system = system.replace(solver_maxls=program["backend"]["halvings"])
        if program["contacts"]:
            _check_contacts(system)
        super().__init__(system)


def _check_contacts(system):
    from mujoco import mjx

    if mjx.make_data(system).ncon == 0:
        raise NotImplementedError("Brax finds no contacts in the twin")
