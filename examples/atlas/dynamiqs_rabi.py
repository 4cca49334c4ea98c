"""A driven qubit."""

import dynamiqs as dq
import jax.numpy as jnp
import numpy as np

dq.set_precision("double")
about = {
    "package": "dynamiqs",
    "python": "jax",
    "requires": "dynamiqs",
    "examine": "grad=jax calls=600",
    "derivative": "right",
    "how": "closed form",
}
theta = np.array([1.3, 0.7])


def cost(p):
    """Return the excited share after 4 units of time."""
    energy = p[0] / 2 * dq.sigmax() + p[1] / 2 * dq.sigmaz()
    states = dq.sesolve(energy, dq.basis(2, 1), jnp.array([0.0, 4.0]), progress_meter=False).states
    return jnp.abs(states[-1].to_jax()[0, 0]) ** 2


def truth():
    """Return the derivative of Rabi's formula."""
    drive, detuning = (theta + 1e-30j * np.eye(2)).T
    both = np.sqrt(drive**2 + detuning**2)
    return ((drive / both * np.sin(2 * both)) ** 2).imag / 1e-30
